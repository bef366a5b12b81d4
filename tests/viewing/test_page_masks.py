"""Masks in the page, in a real browser: where it opens, why a pixel is masked, corrections by hand."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.harness.trained_models import view_runs
from ambiguous_wild.io.images import read_gray, write_png
from ambiguous_wild.io.mask_reasons import reasons_of, write_reasons
from ambiguous_wild.io.motion_points import FILE, MotionPoints, write_motion_points
from ambiguous_wild.io.ply import read_splat_ply
from ambiguous_wild.io.spz import decode_spz
from tests.chromium import Browser, needs_chromium
from tests.report.board_runs import change_result
from tests.tiny_scene import HEIGHT, TRAIN, WIDTH
from tests.viewing.open_page import box, facts, mouse, settle
from tests.viewing.wall_runs import write_mixed_scene, write_shown_run

pytestmark = [pytest.mark.slow, needs_chromium]
HOSTILE = "</script><img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile"), width=800, height=560, webgl=True) as page:
        yield page


@pytest.fixture(scope="module")
def removed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """3dgs without masks, and refinesplat with masks and their reasons; test photos may hold distractors."""
    root = tmp_path_factory.mktemp("removed")
    scene = write_mixed_scene(root / "porch")
    some = np.ones(4, np.uint8)
    xy = np.array([[45, 9], [50, 12], [55, 16], [50, 20]], np.float32) / [WIDTH, HEIGHT]
    moving = MotionPoints(xy.astype(np.float32), 0 * some, some, some.astype(np.int16))
    write_motion_points(scene / FILE, {TRAIN[1]: moving})
    shutil.rmtree(write_shown_run(root / "runs", scene, "3dgs") / "masks")
    run = write_shown_run(root / "runs", scene, "refinesplat", 1)
    keep = read_gray(run / "masks" / TRAIN[1])
    keep[4:30, 40:60] = 0
    write_png(run / "masks" / TRAIN[1], keep)
    regions = np.where(keep > 0, 0, 1)
    regions[:, :10] = 2
    why = ["kept: it looks as predicted", "masked: it differs", HOSTILE]
    write_reasons(run / "reasons.json", {TRAIN[1]: reasons_of(regions, why)})
    change_result(run, lambda r: r.update(reproduce=f"aw bench --method refinesplat --scene {scene}"))
    view_runs([root / "runs"], root / "view")
    return root / "view" / "index.html"


@pytest.fixture
def masked(removed: Path, browser: Browser) -> Browser:
    browser.open("about:blank#")
    browser.open(removed.as_uri())
    browser.run("localStorage.clear()")
    browser.open("about:blank#")
    browser.open(removed.as_uri())
    settle(browser)
    return browser


def spot(page: Browser, u: float, v: float) -> tuple[float, float]:
    """Where a pixel of the photo, in shares, is on the screen: in the pane, or in the enlarged photo."""
    at = f"""(() => {{
      const large = $("photo").className === "large" && !$("photo").hidden;
      const b = (large ? $("photo").querySelector("canvas") : over.element).getBoundingClientRect();
      const view = DATA.views[state.view], f = fitted(view, b.width, b.height);
      return [b.x + f.left + {u} * f.scale * view.width, b.y + f.top + {v} * f.scale * view.height];
    }})()"""
    x, y = facts(page, at)
    return x, y


def press(page: Browser, *spots: tuple[float, float]) -> None:
    """Press the mouse at the first spot, move it over the others, release it at the last one."""
    mouse(page, "mousePressed", *spots[0], button="left", clickCount=1)
    for x, y in spots[1:]:
        mouse(page, "mouseMoved", x, y, button="left", buttons=1)
    mouse(page, "mouseReleased", *spots[-1], button="left", clickCount=1)


def test_it_opens_where_most_moves_with_the_method_that_masks_right(masked: Browser) -> None:
    assert facts(masked, "[DATA.models[state.left].label, DATA.models[state.right].label]") == [
        "3dgs", "refinesplat",
    ]  # fmt: skip
    assert masked.run("state.mode") == "cut" and masked.run("DATA.views[state.view].name") == TRAIN[1]
    y = box(masked)[1]
    at = facts(
        masked,
        "(() => { const b = $('stood').getBoundingClientRect(); return [b.x + b.width / 2, b.bottom]; })()",
    )
    wanted = spot(masked, 50 / WIDTH, 4 / HEIGHT)
    assert abs(at[0] - wanted[0]) < 3 and abs(at[1] - max(wanted[1], y + 60)) < 8
    # the mask of the right model, which the caption names
    assert "mask of refinesplat" in masked.run("$('photo').querySelector('figcaption').textContent")
    # PSNR of test photos with distractors crowns nobody
    assert "dB" not in masked.run("$('left').textContent + $('right').textContent")
    masked.run("choose({ view: 0 }).then(() => 1)")
    assert masked.run("$('said').textContent").count(" dB*") == 2 and masked.run("$('stood').hidden")
    assert "rewards ghosts" in masked.run("$('notes').textContent")


def test_a_click_says_why_a_pixel_is_masked(masked: Browser) -> None:
    for spot_, sentence in (
        ((50, 10), "masked: it differs"),
        ((30, 40), "kept: it looks as predicted"),
        ((4, 4), HOSTILE),
    ):
        press(masked, spot(masked, (spot_[0] + 0.5) / WIDTH, (spot_[1] + 0.5) / HEIGHT))
        masked.until(f"$('why').textContent === {json.dumps(sentence)}")
        assert masked.run("state.view !== null")  # the camera stays
    # in the enlarged photo too; Escape closes the sentence, then makes the photo small
    masked.click("#photo canvas")
    masked.until("$('photo').className === 'large'")
    press(masked, spot(masked, 50.5 / WIDTH, 10.5 / HEIGHT))
    masked.until("$('why').textContent === 'masked: it differs'")
    masked.key("Escape")
    assert masked.run("$('why').textContent === '' && $('photo').className === 'large'")
    masked.key("Escape")
    masked.until("$('photo').className === ''")
    # without reasons the mask alone is said
    masked.run(f"choose({{ view: DATA.views.findIndex((v) => v.name === '{TRAIN[0]}') }}).then(() => 1)")
    press(masked, spot(masked, 20.5 / WIDTH, 20.5 / HEIGHT))
    masked.until("$('why').textContent === 'masked by refinesplat'")
    masked.run("choose({ view: 0 }).then(() => 1)")
    press(masked, spot(masked, 0.5, 0.5))
    masked.until("$('why').textContent === 'a test photo: it has no mask'")
    assert masked.errors == []


def corrections(page: Browser) -> dict[str, np.ndarray]:
    file = facts(page, "correctionsFile()")
    assert (file["version"], file["scene"]) == (1, "porch")
    decoded = {}
    for name, uri in file["photos"].items():
        data = np.frombuffer(base64.b64decode(uri.removeprefix("data:image/png;base64,")), np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert image.shape == (HEIGHT, WIDTH, 3) and (image == image[:, :, :1]).all()
        decoded[name] = image[:, :, 0]
    return decoded


def test_masks_are_corrected_by_hand(masked: Browser, removed: Path) -> None:
    masked.click("#correct")
    masked.until("$('photo').className === 'large' && !$('tools').hidden")
    settle(masked)
    # a region that is too large, a full undo and an empty file leave nothing that blocks the page
    masked.click("#tool-region")
    press(masked, spot(masked, 0.5, 0.95))
    masked.until("$('corrected').textContent.includes('use the brush')")
    assert not masked.run("unsaved()") and corrections(masked) == {}
    masked.click("#tool-mask")
    press(masked, spot(masked, 0.3, 0.8))
    masked.until("steps.length === 1 && unsaved()")
    masked.key("z")
    masked.until("steps.length === 0")
    assert not masked.run("unsaved()") and corrections(masked) == {}
    masked.run("window.files = []; save = (name, blob) => files.push([name, blob])")
    masked.click("#save-corrections")
    assert masked.run("files.length === 0 && $('corrected').textContent === 'nothing is corrected yet'")
    press(masked, *(spot(masked, u, 0.8) for u in (0.2, 0.5, 0.7)))
    masked.until("steps.length === 1")
    painted = corrections(masked)[TRAIN[1]]
    assert set(np.unique(painted)) == {0, 128}
    rows, columns = np.nonzero(painted == 0)
    assert abs(rows - 0.8 * HEIGHT).max() <= 2.5 and set(range(14, 44)) <= set(columns.tolist())
    # a click on the mask keeps its whole region; a larger brush
    masked.click("#tool-region")
    press(masked, spot(masked, 50.5 / WIDTH, 10.5 / HEIGHT))
    masked.until("steps.length === 2")
    both = corrections(masked)[TRAIN[1]]
    assert (both[4:30, 40:60] == 255).all() and (both == 255).sum() == 26 * 20
    # the wall is more than half of the photo
    press(masked, spot(masked, 0.5, 0.95))
    masked.until("$('corrected').textContent.includes('use the brush')")
    assert (corrections(masked)[TRAIN[1]] == both).all()
    # they are drawn, and survive a reload
    caption = "$('photo').querySelector('figcaption').textContent"
    assert "orange: masked by hand" in masked.run(caption)
    masked.run("window.before = 1; location.reload()")
    masked.until("!window.before && typeof corrections === 'object' && corrections.size === 1")
    settle(masked)
    assert (corrections(masked)[TRAIN[1]] == both).all() and masked.run("unsaved()")
    press(masked, spot(masked, 50.5 / WIDTH, 10.5 / HEIGHT))
    masked.until("$('why').textContent === 'kept: by hand'")
    # undo
    masked.click("#correct")
    masked.until("!$('tools').hidden")
    masked.click("#tool-keep")
    masked.click("#large-brush")
    press(masked, spot(masked, 0.3, 0.8))
    masked.until("steps.length === 1")
    assert (corrections(masked)[TRAIN[1]] == 255).sum() > 26 * 20 + 20
    masked.key("z")
    masked.until("steps.length === 0")
    assert (corrections(masked)[TRAIN[1]] == both).all()
    # the file, and the command that uses it
    masked.run("window.files = []; save = (name, blob) => files.push([name, blob])")
    masked.click("#save-corrections")
    assert masked.run("files[0][0]") == "corrections.json" and not masked.run("unsaved()")
    assert json.loads(masked.run("files[0][1].text()")) == facts(masked, "correctionsFile()")
    panel = masked.run("$('next-steps').textContent")
    assert not masked.run("$('next-steps').hidden")
    assert "--iterations 150 --overwrite longer --corrections corrections.json" in panel
    masked.key("Escape")
    # what is undone after it was saved is not in the file
    press(masked, spot(masked, 0.3, 0.8))
    masked.until("steps.length === 1 && unsaved()")
    masked.key("z")
    masked.until("steps.length === 0 && !unsaved()")
    press(masked, spot(masked, 0.3, 0.8))
    masked.until("steps.length === 1")
    masked.click("#save-corrections")
    masked.key("Escape")
    masked.key("z")
    masked.until("steps.length === 0 && unsaved()")
    masked.key("Escape")
    masked.until("$('tools').hidden && $('photo').className === ''")
    assert masked.errors == []


def test_the_shown_model_is_saved_and_panels_close(masked: Browser, removed: Path) -> None:
    masked.run("window.files = []; save = (name, blob) => files.push([name, blob])")
    masked.click("#next-button")
    assert "masks of refinesplat" in masked.run("$('next-steps').textContent")
    masked.click("#next-steps button:nth-of-type(2)")
    assert masked.run("files[0][0]") == "refinesplat.spz"
    code = "Array.from(new Uint8Array(b), (c) => String.fromCharCode(c)).join('')"
    packed = base64.b64decode(masked.run(f"files[0][1].arrayBuffer().then((b) => btoa({code}))"))
    (ply,) = removed.parents[1].glob("runs/porch/*/seed1/point_cloud.ply")
    saved = decode_spz(packed, "m").gaussians["means"]
    assert len(saved) == len(read_splat_ply(ply)["means"])
    masked.click("#help-button")  # one panel at a time
    assert masked.run("$('next-steps').hidden && !$('help').hidden")
    masked.key("Escape")
    assert (
        masked.run("$('help').hidden")
        and masked.run("$('help-button').getAttribute('aria-expanded')") == "false"
    )


def test_the_photo_in_the_corner_is_small_and_can_be_closed(masked: Browser) -> None:
    box_of = "(() => { const b = $('photo').getBoundingClientRect(), s = $('stage');"
    area = f"{box_of} return b.width * b.height / (s.clientWidth * s.clientHeight); }})()"
    assert masked.run(area) < 0.16
    masked.click("#fold")
    masked.until("$('photo').className === 'closed'")
    assert masked.run(area) < 0.02
    masked.click("#fold")
    masked.until("$('photo').className === ''")


def test_an_old_picture_does_not_stand_under_a_new_name(masked: Browser) -> None:
    # as on a machine without a GPU, where another picture takes seconds
    masked.run("Object.defineProperty(under, 'settled', { get: () => false, configurable: true }) && 1")
    masked.run("choose({ view: 0 }).then(() => 1)")
    assert masked.run("$('busy').textContent") == "drawing …"
    masked.until("getComputedStyle(under.canvas).opacity === '0'")
    masked.run("delete under.settled")
    settle(masked)
    assert masked.run("getComputedStyle(under.canvas).opacity") == "1"
