"""Make a study: an HTML page with the questions, and the key that is needed to score the answers."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TypedDict

import cv2
import numpy as np
import pandas as pd

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.grouping import grouped
from ambiguous_wild.core.names import plain
from ambiguous_wild.harness.result_file import RENDERS, RESULT, check_render, read_result
from ambiguous_wild.harness.store import check_names, read_runs
from ambiguous_wild.harness.trained_models import open_scene
from ambiguous_wild.io.files import write_json, write_text
from ambiguous_wild.io.images import read_gray, read_png_rgb
from ambiguous_wild.io.page_parts import data_uri, fill_page, jpeg_bytes, narrowed
from ambiguous_wild.io.progress_bar import Progress
from ambiguous_wild.io.scene_folder import load_scene, without_suffix
from ambiguous_wild.report.notes import unequal
from ambiguous_wild.report.plain_formats import UNEQUAL
from ambiguous_wild.study.answers import KEY_FORMAT, KEY_VERSION, KIND_PAIR, KIND_PHOTO, study_id

OUTLINE = (255, 220, 0)  # sRGB; drawn over a black edge, so that it is visible on any background


@dataclass(frozen=True)
class PhotoQuestion:
    """The question how hard it is to tell the distractor from the scene."""

    scene: str
    view: str
    photo: Path
    mask: Path | None  # PNG, white = distractor; raters can show the outline

    @property
    def group(self) -> str:
        """The group of the question; questions are chosen evenly over groups."""
        return self.scene


@dataclass(frozen=True)
class PairQuestion:
    """The question which of two renders is better."""

    scene: str
    view: str
    methods: tuple[str, str]
    renders: tuple[Path, Path]
    truth: Path | None  # the test photo, shown next to the renders

    @property
    def group(self) -> str:
        return f"{self.scene}\n{self.methods[0]}\n{self.methods[1]}"


Question = PhotoQuestion | PairQuestion


def scene_photos(folder: Path, *, outline: bool = True) -> list[PhotoQuestion]:
    """Return questions on the training photos of a scene, except those whose exact mask is empty.

    Raises:
        AwError: there is no scene, or no photo with distractors.
    """
    scene = load_scene(folder)
    questions = []
    for view in scene.train:
        mask = scene.truth_file("distractor", view)
        has_mask = mask.is_file()
        if has_mask and not (read_gray(mask) >= 128).any():
            continue
        shown = mask if has_mask and outline else None
        questions.append(PhotoQuestion(scene.name, view.name, view.image_path, shown))
    if not questions:
        raise AwError(
            f"no training photo of {folder} has a distractor in the ground truth: there is nothing to ask; "
            "give a scene with distractors"
        )
    return questions


def render_pairs(
    folder: Path, *, methods: Sequence[str] = (), scenes: Sequence[str] = (), truth: bool = True
) -> list[PairQuestion]:
    """Return all pairs of methods on all test views that both rendered, with the first seed of each.

    Args:
        folder: output of `aw bench -o`.
        methods: names of methods to compare; empty = all.
        scenes: names of scenes to use; empty = all.
        truth: show the test photo next to the renders.

    Raises:
        AwError: no runs, an unknown name, less than two methods on a scene, runs on other photos or pixels,
            or missing renders or photos.
    """
    frame = read_runs(folder).runs
    frame = frame[frame["status"] == "ok"]
    for kind, asked in (("method", methods), ("scene", scenes)):
        check_names(kind, asked, sorted(set(frame[kind])))
    frame = frame[frame["images"] > 0]
    if methods:
        frame = frame[frame["method"].isin(methods)]
    if scenes:
        frame = frame[frame["scene"].isin(scenes)]
    pairs: list[PairQuestion] = []
    for scene, rows in frame.groupby("scene", sort=True):
        first = rows.sort_values("seed").drop_duplicates("method").sort_values("method")
        _check_comparable(str(scene), first)
        folders = {str(r["method"]): Path(str(r["folder"])) for r in first.to_dict("records")}
        pairs += _pairs_of_scene(str(scene), folders, truth)
    if not pairs:
        raise AwError(
            f"{folder} has no scene with test photos and finished runs of two methods: there is nothing to "
            "compare; run a second method with 'aw bench'"
        )
    return pairs


def _check_comparable(scene: str, runs: pd.DataFrame) -> None:
    """Refuse runs that saw other photos or fitted another part of them; warn where settings differ."""
    for what, of in (("version of the scene", runs["scene_hash"]), ("--protocol", runs["fit"] == "full")):
        if of.nunique() > 1:
            raise AwError(
                f"the runs on {scene} cannot be compared: their {what} differs "
                f"({shortlist(runs['method'])}); run them again alike, or choose with --method"
            )
    for line in unequal(runs):
        if line.startswith(UNEQUAL):
            warnings.warn(plain(line), stacklevel=3)


def _pairs_of_scene(scene: str, folders: dict[str, Path], truth: bool) -> list[PairQuestion]:
    if len(folders) < 2:
        return []
    renders = {m: _renders(f) for m, f in folders.items()}
    common = set.intersection(*(set(r) for r in renders.values()))
    if not common:
        without = [m for m, r in renders.items() if not r]
        which = f"{shortlist(without)} lacks renders/test" if without else "they share no test view"
        raise AwError(f"the runs on {scene} cannot be compared: {which}; make them again with 'aw bench'")
    photos = _test_photos(next(iter(folders.values()))) if truth else {}
    missing = sorted(common - set(photos)) if truth else []
    if missing:
        raise AwError(
            f"{scene} has no test photo for {shortlist(missing)}: restore the scene, or give --no-truth"
        )
    return [
        PairQuestion(scene, stem, (a, b), (renders[a][stem], renders[b][stem]), photos.get(stem))
        for a, b in combinations(sorted(folders), 2)
        for stem in sorted(common)
    ]


def _renders(run: Path) -> dict[str, Path]:
    """Renders by the names of their views, which may lie in folders."""
    result, folder = read_result(run / RESULT), run / RENDERS
    for name in result.get("render_sha256", {}):
        check_render(run, result, name)
    return {without_suffix(p.relative_to(folder).as_posix()): p for p in sorted(folder.rglob("*.png"))}


def _test_photos(run: Path) -> dict[str, Path]:
    try:
        scene = open_scene(run)
    except AwError as error:
        raise AwError(f"{error}; --no-truth leaves the photos out") from None
    return {without_suffix(v.name): v.image_path for v in scene.test}


def sample_questions(questions: Sequence[Question], limit: int, rng: np.random.Generator) -> list[Question]:
    """Choose at most `limit` questions, spread evenly over their groups, in random order."""
    groups = grouped(questions, lambda question: question.group)
    for members in groups.values():
        rng.shuffle(members)
    names = sorted(groups)
    rng.shuffle(names)
    chosen: list[Question] = []
    while len(chosen) < limit and any(groups.values()):
        chosen += [groups[n].pop() for n in names if groups[n]][: limit - len(chosen)]
    return [chosen[i] for i in rng.permutation(len(chosen))]


def outlined(photo: Path, mask: Path) -> np.ndarray:  # [H, W, 3] uint8
    """Draw the outline of the distractor on the photo."""
    image = read_png_rgb(photo).copy()
    height, width = image.shape[:2]
    inside = cv2.resize(read_gray(mask), (width, height), interpolation=cv2.INTER_NEAREST) >= 128
    contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    thick = max(2, round(max(height, width) / 300))
    cv2.drawContours(image, contours, -1, (0, 0, 0), 2 * thick)
    cv2.drawContours(image, contours, -1, OUTLINE, thick)
    return image


def same_size(paths: tuple[Path, ...]) -> list[np.ndarray]:
    """Read the images of one question, whose sizes must be equal: size would reveal the method.

    Raises:
        AwError: an image is unreadable, or sizes differ.
    """
    images = [read_png_rgb(p) for p in paths]
    sizes = {f"{i.shape[1]}x{i.shape[0]}" for i in images}
    if len(sizes) > 1:
        listed = ", ".join(f"{p} ({i.shape[1]}x{i.shape[0]})" for p, i in zip(paths, images))
        raise AwError(
            f"images of one question differ in size: {listed}; run all methods with the same --factor"
        )
    return images


@dataclass(frozen=True)
class StudySettings:
    """Settings of a study."""

    title: str = "Picture study"  # shown to raters
    limit: int = 40  # largest number of questions of each kind
    side: int = 1000  # px, longest side of an image
    quality: int = 92  # of JPEG
    seed: int = 0  # for the choice of questions, and of the render that is x


@dataclass(frozen=True)
class StudyFiles:
    """The files of a study and what they contain."""

    page: Path
    key: Path
    study: str
    photos: int  # questions about photos
    pairs: int  # questions about renders
    pictures: int
    megabytes: float  # of the page


def make_study(
    questions: Sequence[Question], page: Path, key: Path, settings: StudySettings, progress: Progress = iter
) -> StudyFiles:
    """Choose questions, encode their images, write the page and the key.

    The page contains only random tokens for images and questions: no method, scene, file or path.

    Raises:
        AwError: no question, an unreadable image, or images of one question that differ in size.
    """
    rng = np.random.default_rng(settings.seed)
    photos = sample_questions([q for q in questions if isinstance(q, PhotoQuestion)], settings.limit, rng)
    pairs = sample_questions([q for q in questions if isinstance(q, PairQuestion)], settings.limit, rng)
    chosen = [*photos, *pairs]
    if not chosen:
        raise AwError("a study needs at least one question: give RUNS, --scene or both")
    album = _Album(settings, rng)
    asked: list[ShownQuestion] = []
    answers = {}
    for question in progress(chosen):
        token = album.token()
        if isinstance(question, PhotoQuestion):
            images, entry = _photo(question, album)
        else:
            images, entry = _pair(question, album, rng)
        asked.append({"id": token, "kind": entry["kind"], "images": images})
        answers[token] = entry
    # the id depends on the images: the same questions on other renders are another study
    identity = study_id(settings.title, asked, answers, album.hashes)
    data = {"study": identity, "title": settings.title, "questions": asked, "images": album.images}
    text = fill_page(Path(__file__).parent, data, ("page.js",))
    write_text(page, text)  # before the key, so that there is no key without a page
    write_json(
        key,
        {
            "format": KEY_FORMAT,
            "version": KEY_VERSION,
            "study": identity,
            "title": settings.title,
            "seed": settings.seed,
            "questions": answers,
        },
    )
    size = len(text.encode()) / 1e6
    return StudyFiles(page, key, identity, len(photos), len(pairs), len(album.images), size)


class _Album:
    """The images of a page by random token; an image that is used twice is stored once."""

    def __init__(self, settings: StudySettings, rng: np.random.Generator) -> None:
        self._settings, self._rng = settings, rng
        self._tokens: dict[str, str] = {}
        self._used: set[str] = set()
        self.images: dict[str, str] = {}

    def token(self) -> str:
        while (token := self._rng.bytes(5).hex()) in self._used:
            pass
        self._used.add(token)
        return token

    def add(self, name: str, image: np.ndarray) -> str:
        if name not in self._tokens:
            token = self._tokens[name] = self.token()
            self.images[token] = self._encoded(image)
        return self._tokens[name]

    def _encoded(self, image: np.ndarray) -> str:
        """Encode the pixels alone, without EXIF or file name, and with full resolution of colour."""
        width = image.shape[1] * self._settings.side // max(image.shape[:2])
        small = narrowed(image, max(1, width))
        return data_uri("jpeg", jpeg_bytes(small, self._settings.quality, full_colour=True))

    @property
    def hashes(self) -> dict[str, str]:
        return {t: hashlib.sha256(uri.encode()).hexdigest() for t, uri in self.images.items()}


class ShownQuestion(TypedDict):
    """A question as the page shows it."""

    id: str  # token
    kind: str
    images: dict[str, str]  # "photo", "outline", or "x", "y", "truth" -> token of the image


def _photo(question: PhotoQuestion, album: _Album) -> tuple[dict[str, str], dict[str, str]]:
    """Return tokens of the images that the page shows, and the entry of the key."""
    images = {"photo": album.add(str(question.photo), read_png_rgb(question.photo))}
    if question.mask is not None:
        images["outline"] = album.add(f"{question.mask} outlined", outlined(question.photo, question.mask))
    return images, {"kind": KIND_PHOTO, "scene": question.scene, "view": question.view}


def _pair(
    question: PairQuestion, album: _Album, rng: np.random.Generator
) -> tuple[dict[str, str], dict[str, str]]:
    """Return tokens of the images that the page shows, and the entry of the key."""
    order = [1, 0] if rng.integers(2) else [0, 1]
    paths = tuple(question.renders[i] for i in order)
    sources = paths if question.truth is None else (*paths, question.truth)
    pixels = same_size(sources)
    images = {slot: album.add(str(p), i) for slot, p, i in zip(("x", "y", "truth"), sources, pixels)}
    entry = {"kind": KIND_PAIR, "scene": question.scene, "view": question.view,
             "x": question.methods[order[0]], "y": question.methods[order[1]]}  # fmt: skip
    return images, entry
