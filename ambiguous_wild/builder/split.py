"""The split into training and test photos, as lists of names."""

from __future__ import annotations

import difflib
from pathlib import Path, PurePosixPath

from ambiguous_wild.builder.records import ScreenedPhoto
from ambiguous_wild.core.errors import AwError, shortlist
from ambiguous_wild.io.scene_folder import TEST_EVERY, read_list


def split_photos(
    facts: list[ScreenedPhoto], registered: set[str], test_stems: set[str] | None
) -> tuple[list[str], list[str], str, list[str]]:
    """Names of the training and the test photos.

    Args:
        facts: screened photos.
        registered: stems in the model.
        test_stems: from the user's test list, or None.

    Returns:
        (train, test, "list" or "folders" or "every-8", warnings); names are ``<stem>.png``, sorted.

    Raises:
        AwError: fewer than two training photos, or a test set without a placed photo.
    """
    inside = sorted(f["stem"] for f in facts if f["stem"] in registered)
    warnings = []
    if test_stems is not None:
        how, test = "list", [s for s in inside if s in test_stems]
        wanted = len(test_stems)
    elif any(f["side"] for f in facts):
        sides = {f["stem"]: f["side"] for f in facts}
        how, test = "folders", [s for s in inside if sides[s] == "test"]
        wanted = sum(f["side"] == "test" for f in facts)
    else:
        how, test = f"every-{TEST_EVERY}", inside[::TEST_EVERY]
        wanted = len(test)
        warnings.append(
            f"no test set given, so every {TEST_EVERY}th photo tests: distractors in these photos count "
            "as truth in the scores; give clean photos in test/, or --test-list FILE"
        )
    train = sorted(set(inside) - set(test))
    if wanted and not test:
        raise AwError(
            f"none of the {wanted} test photos could be placed among the training photos: they show "
            "another place or too little overlap; take them nearer to the training views"
        )
    if len(train) < 2:
        raise AwError(f"only {len(train)} training photos could be placed; a scene needs at least 2")
    if len(test) < wanted:
        warnings.append(f"{wanted - len(test)} of {wanted} test photos are lost: scores cover {len(test)}")
    return [f"{s}.png" for s in train], [f"{s}.png" for s in test], how, warnings


def read_test_list(path: Path, facts: list[ScreenedPhoto]) -> set[str]:
    """Stems of the photos in a test list, which names them by path, by file name or without extension.

    Raises:
        AwError: the file cannot be read or is empty, names an unknown photo, or names all photos.
    """
    try:
        names = read_list(path)
    except (OSError, UnicodeDecodeError) as error:
        raise AwError(f"cannot read the test list {path}: {error}") from error
    known: dict[str, str] = {}
    for fact in facts:
        source = PurePosixPath(fact["source"])
        for key in (str(source), source.name, source.stem, fact["stem"], fact["stem"] + ".png"):
            known.setdefault(key, fact["stem"])
        for copy in fact.get("copies", ()):
            known.setdefault(copy, fact["stem"])
    unknown = [n for n in names if n not in known]
    if unknown:
        what = "a photo" if len(unknown) == 1 else f"{len(unknown)} photos"
        sources = {f["stem"]: f["source"] for f in facts}
        raise AwError(
            f"{path} names {what} not in the capture: "
            + shortlist((_with_nearest(n, known, sources) for n in unknown), 3)
        )
    if not names:
        raise AwError(f"{path} is empty; list test photos one a line, or leave out --test-list")
    tests = {known[n] for n in names}
    if len(tests) == len(facts):
        raise AwError(f"{path} names all {len(facts)} photos: no training photo would be left; list fewer")
    return tests


def _with_nearest(name: str, known: dict[str, str], sources: dict[str, str]) -> str:
    """The unknown name, and the photo whose name is nearest to it."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"{name!r} (did you mean {sources[known[near[0]]]!r}?)" if near else repr(name)
