"""Names of masks: what is written for a tool is found again."""

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.io.mask_files import MASK_STYLES, OWN_STYLE, find_masks, mask_names

PHOTOS = ["front/IMG_1.JPG", "back/IMG_1.JPG", "two words.jpeg", "a.b.png"]
STYLES = {**MASK_STYLES, "own": OWN_STYLE}


@pytest.mark.parametrize("tool", STYLES)
def test_masks_of_every_tool_are_found_again(tool, tmp_path):
    names = mask_names(PHOTOS, STYLES[tool])
    for name in names.values():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert find_masks(tmp_path, PHOTOS) == {photo: tmp_path / name for photo, name in names.items()}


def test_names_are_those_that_the_tools_document():
    one = {tool: mask_names(["a.jpg"], style)["a.jpg"] for tool, style in STYLES.items()}
    assert one == {
        "colmap": "a.jpg.png", "nerfstudio": "a.png", "metashape": "a_mask.png",
        "realityscan": "a.jpg.mask.png", "postshot": "a.png", "lichtfeld": "a.png", "own": "a.png",
    }  # fmt: skip
    assert [tool for tool, style in STYLES.items() if style.left_out] == ["postshot"]


def test_two_photos_never_share_a_mask():
    with pytest.raises(AwError, match=r"masks of a\.jpg and A\.png would both be A\.png.*--for colmap"):
        mask_names(["a.jpg", "A.png"], OWN_STYLE)
    assert len(set(mask_names(["a.jpg", "A.png"], MASK_STYLES["colmap"]).values())) == 2
