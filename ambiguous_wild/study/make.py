"""Make a study: an HTML page with the questions, and the key that is needed to score the answers."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from ambiguous_wild.core import AwError
from ambiguous_wild.io.atomic import write_json, write_text
from ambiguous_wild.io.images import read_png_rgb
from ambiguous_wild.study.key import FORMAT, KIND_PAIR, KIND_PHOTO, VERSION, study_id
from ambiguous_wild.study.pictures import data_uri, outlined, same_size
from ambiguous_wild.study.questions import PairQuestion, PhotoQuestion, Question, sample_questions

Bar = Callable[[list[Question]], Iterable[Question]]


@dataclass(frozen=True)
class StudySettings:
    """Settings of a study."""

    title: str = "Picture study"  # shown to raters
    limit: int = 40  # most questions of each kind
    side: int = 1000  # px, most of an image's longer side
    quality: int = 92  # of JPEG
    seed: int = 0  # of the choice of questions, and of which render is x


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
    questions: Sequence[Question], page: Path, key: Path, settings: StudySettings, progress: Bar = iter
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
        raise AwError("a study needs at least one question: give --scene, --runs or both")
    album = _Album(settings, rng)
    asked, answers = [], {}
    for question in progress(chosen):
        token = album.token()
        if isinstance(question, PhotoQuestion):
            shown, entry = _photo(question, album)
        else:
            shown, entry = _pair(question, album, rng)
        asked.append({"id": token, **shown})
        answers[token] = entry
    # The id depends on the images: the same questions on other renders are another study.
    identity = study_id(settings.title, asked, answers, album.hashes)
    data = {"study": identity, "title": settings.title, "questions": asked, "images": album.images}
    text = page_html(data)
    write_text(page, text)  # first, so that there is no key without its page
    write_json(
        key,
        {
            "format": FORMAT,
            "version": VERSION,
            "study": identity,
            "title": settings.title,
            "seed": settings.seed,
            "questions": answers,
        },
    )
    size = len(text.encode()) / 1e6
    return StudyFiles(page, key, identity, len(photos), len(pairs), len(album.images), size)


class _Album:
    """Images by random token; an image that is used twice is stored once."""

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
            self.images[token] = data_uri(image, side=self._settings.side, quality=self._settings.quality)
        return self._tokens[name]

    @property
    def hashes(self) -> dict[str, str]:
        return {t: hashlib.sha256(uri.encode()).hexdigest() for t, uri in self.images.items()}


def _photo(question: PhotoQuestion, album: _Album) -> tuple[dict[str, Any], dict[str, str]]:
    """What the page shows, and the entry of the key."""
    shown = {"photo": album.add(str(question.photo), read_png_rgb(question.photo))}
    if question.mask is not None:
        shown["outline"] = album.add(f"{question.mask} outlined", outlined(question.photo, question.mask))
    entry = {"kind": KIND_PHOTO, "scene": question.scene, "view": question.view}
    return {"kind": KIND_PHOTO, "images": shown}, entry


def _pair(
    question: PairQuestion, album: _Album, rng: np.random.Generator
) -> tuple[dict[str, Any], dict[str, str]]:
    """What the page shows, and the entry of the key."""
    order = [1, 0] if rng.integers(2) else [0, 1]
    paths = tuple(question.renders[i] for i in order)
    sources = paths if question.truth is None else (*paths, question.truth)
    images = same_size(sources)
    shown = {slot: album.add(str(p), i) for slot, p, i in zip(("x", "y", "truth"), sources, images)}
    entry = {"kind": KIND_PAIR, "scene": question.scene, "view": question.view,
             "x": question.methods[order[0]], "y": question.methods[order[1]]}  # fmt: skip
    return {"kind": KIND_PAIR, "images": shown}, entry


def page_html(data: dict[str, Any]) -> str:
    """The HTML page with its data, escaped so that it cannot end its script element."""
    here = files("ambiguous_wild.study")
    text = json.dumps(data, ensure_ascii=True, allow_nan=False)
    text = text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    page = (here / "page.html").read_text(encoding="utf-8")
    parts = {"STYLE": "page.css", "SCRIPT": "page.js"}
    for mark, name in parts.items():
        page = page.replace(f"/*{mark}*/", (here / name).read_text(encoding="utf-8"))
    return page.replace("/*DATA*/", text)
