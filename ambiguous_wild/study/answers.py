"""Read the key of a study, and check the answer files of its raters against the key."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypedDict

from ambiguous_wild.core import AwError
from ambiguous_wild.core.errors import shortlist
from ambiguous_wild.core.names import is_text, quoted

KEY_FORMAT, KEY_VERSION = "aw-study-key", 1
KIND_PHOTO: Final = "ambiguity"
KIND_PAIR: Final = "preference"
_KEY_FIELDS = {KIND_PHOTO: ("scene", "view"), KIND_PAIR: ("scene", "view", "x", "y")}
FORMAT, VERSION = "aw-study-answers", 1
CHOICES = {KIND_PAIR: ("x", "y", "tie"), KIND_PHOTO: ("1", "2", "3", "4", "5", "none")}
# the values in JSON and CSV -> whether the outline was shown
OUTLINES: dict[str | bool | None, bool | None] = {
    True: True,
    False: False,
    "yes": True,
    "no": False,
    "": None,
    None: None,
}
LARGEST = 5_000_000  # bytes; ten times the size of a thousand answers
LONGEST = 80  # characters of a rater's id or name, as in the page
_COLUMNS = ("study", "rater", "name", "question", "answer", "left", "ms", "outline")
# Nobody can look at a question in less than these seconds: at one photo, or at two renders and a photo. Such
# answers are read and counted, but left out of every score.
TOO_FAST_S = {KIND_PHOTO: 0.7, KIND_PAIR: 1.0}


@dataclass(frozen=True)
class Key:
    """The key that is needed to score answers."""

    study: str  # id of the study
    title: str
    questions: dict[str, dict[str, str]]  # token -> kind, scene, view and, for pairs, the methods x and y


def study_id(*parts: Any) -> str:
    """Return the hash of `parts`, 16 hexadecimal digits."""
    text = json.dumps(parts, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_key(path: Path) -> Key:
    """Read and check a key.

    Raises:
        AwError: the file is unreadable, no key, of another version, or damaged.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AwError(
            f"cannot read the key {path}: {error.strerror}; 'aw study make' wrote it next to the page"
        ) from None
    except (ValueError, RecursionError) as error:
        raise _damaged(path, str(error)) from None
    if not isinstance(data, dict) or data.get("format") != KEY_FORMAT:
        raise AwError(f"{path} is no key of a study; 'aw study make' wrote it next to the page (*.key.json)")
    if data.get("version") != KEY_VERSION:
        raise AwError(
            f"the key {path} has version {data.get('version')!r}, this program reads {KEY_VERSION}; update it"
        )
    questions = data.get("questions")
    complete = (
        isinstance(data.get("study"), str)
        and isinstance(data.get("title"), str)
        and isinstance(questions, dict)
        and bool(questions)
        and all(_complete(entry) for entry in questions.values())
    )
    if not complete:
        raise _damaged(path, "a field is missing")
    if not is_text(json.dumps(data, ensure_ascii=False)):
        raise _damaged(path, "half a character")
    return Key(data["study"], data["title"], data["questions"])


def _damaged(path: Path, why: str) -> AwError:
    return AwError(f"the key {path} is damaged ({why}); use the one that 'aw study make' wrote")


def _complete(entry: Any) -> bool:
    kind = entry.get("kind") if isinstance(entry, dict) else None
    if not isinstance(kind, str) or kind not in _KEY_FIELDS:
        return False
    return all(isinstance(entry.get(field), str) for field in _KEY_FIELDS[kind])


@dataclass(frozen=True)
class Answer:
    """One answer of one rater."""

    question: str  # token of the key
    answer: str  # one of `CHOICES`
    left: str  # "x" or "y": the render shown on the left; empty for photos
    seconds: float  # spent on the question
    too_fast: bool = False  # see `TOO_FAST_S`
    outline: bool | None = None  # whether the outline was shown; None: not recorded, or there is none


@dataclass(frozen=True)
class Rater:
    """One rater and the answers in the rater's file."""

    rater: str  # random id, made by the page
    name: str  # as typed; it may be any text
    path: Path
    answers: tuple[Answer, ...]


def read_answers(
    paths: Sequence[Path], key: Key, notice: Callable[[str], None] = lambda text: None
) -> list[Rater]:
    """Read the answer files (JSON or CSV, or folders of them), ordered by rater.

    Args:
        paths: files and folders.
        key: key of the study.
        notice: called with a message about ignored files of a folder.

    Raises:
        AwError: there is no file, or one is empty, malformed, of another study or of a repeated rater, or
            answers an unknown question; the error names the file.
    """
    raters: dict[str, Rater] = {}
    for path in _files(paths, notice):
        rater = _read(path, key)
        if rater.rater in raters:
            raise AwError(
                f"{raters[rater.rater].path} and {path} are both of rater {rater.rater!a}: give only one "
                "(the one saved last has all answers)"
            )
        raters[rater.rater] = rater
    return [raters[name] for name in sorted(raters)]


def _files(paths: Sequence[Path], notice: Callable[[str], None]) -> list[Path]:
    files: list[Path] = []
    for path in paths:
        if not path.is_dir():
            files.append(path)
            continue
        # the folder may also hold the key and earlier scores
        inside = [
            p
            for p in sorted(path.iterdir())
            if p.suffix.lower() in (".json", ".csv")
            and not p.name.endswith(".key.json")
            and not p.name.startswith(("scores.", "."))
        ]
        if not inside:
            raise AwError(f"no answer file (*.json, *.csv) in {path}; copy the raters' files there")
        files += inside
        study_files = (".key.json", ".html", ".htm")
        ignored = [
            p.name
            for p in sorted(path.iterdir())
            if p not in inside
            and not p.name.startswith((".", "scores."))
            and not p.name.endswith(study_files)
        ]
        if ignored:
            notice(
                f"{path}: ignored {shortlist(ignored)}; answer files are *.json or *.csv in the folder itself"
            )
    twice = {p.resolve() for p in files if sum(p.resolve() == q.resolve() for q in files) > 1}
    if twice:
        raise AwError(f"given twice: {shortlist(sorted(map(str, twice)))}; give each answer file once")
    if not files:
        raise AwError("no answer files given: name the files that raters saved, or a folder of them")
    return files


def _read(path: Path, key: Key) -> Rater:
    try:
        if path.stat().st_size > LARGEST:
            raise AwError(
                f"{path} is larger than {LARGEST // 1_000_000} MB, so it is no answer file; leave it out"
            )
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise AwError(f"{path} is not UTF-8 text, so it is no answer file; leave it out") from None
    except OSError as error:
        raise AwError(f"cannot read {path}: {error.strerror}") from None
    if not text.strip():
        raise AwError(f"{path} is empty: ask the rater to save again")
    # the content decides on the format, since mail programs and phones rename files
    data = _json(path, text) if text.lstrip()[:1] in ("{", "[") else _csv(path, text)
    if data["study"] != key.study:
        raise AwError(
            f"{path} answers study {quoted(data['study'])}, but the key is of study {key.study}: the page is "
            "another one or was made again; give the key of its page"
        )
    rater, name = data["rater"], data["name"]
    if isinstance(rater, str):
        rater = rater.strip()  # ignore blanks, so that a copy is recognised
    if not isinstance(rater, str) or not rater.strip() or len(rater) > LONGEST or not isinstance(name, str):
        raise _edited(path, f"has no valid rater ({quoted(rater)})")
    if not is_text(rater) or not is_text(name):
        raise _edited(path, "has half a character in its rater or name")
    answers = tuple(_answer(path, row, key) for row in data["answers"])
    if not answers:
        raise AwError(f"{path} contains no answer: leave it out")
    asked = [a.question for a in answers]
    if len(set(asked)) < len(asked):
        double = sorted({q for q in asked if asked.count(q) > 1})
        raise _edited(path, f"answers a question twice ({shortlist(double)})")
    return Rater(rater, name[:LONGEST], path, answers)


class AnswerFile(TypedDict):
    """The content of an answer file; its values are not checked yet."""

    study: object
    rater: object
    name: object
    answers: list[Any]


def _json(path: Path, text: str) -> AnswerFile:
    try:
        data = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise AwError(f"{path} is truncated or malformed ({error}): ask the rater to save again") from None
    if isinstance(data, dict) and data.get("format") == KEY_FORMAT:
        raise AwError(f"{path} is the key, not an answer file: give it with --key")
    if (
        not isinstance(data, dict)
        or data.get("format") != FORMAT
        or not isinstance(data.get("answers"), list)
    ):
        raise AwError(f"{path} is no answer file of a study page; leave it out")
    if data.get("version") != VERSION:
        raise AwError(
            f"{path} has version {quoted(data.get('version'))}, this program reads {VERSION}; update it"
        )
    study, rater, name = (data.get(k, "") for k in ("study", "rater", "name"))
    return {"study": study, "rater": rater, "name": name, "answers": data["answers"]}


def _csv(path: Path, text: str) -> AnswerFile:
    try:
        rows = list(csv.DictReader(io.StringIO(text, newline=""), strict=True))
    except csv.Error as error:
        raise AwError(f"{path} is malformed CSV ({error}): ask the rater to save again") from None
    # pages of early versions did not record the outline, and lack the last column
    if not rows or tuple(rows[0]) not in (_COLUMNS, _COLUMNS[:-1]):
        raise AwError(
            f"{path} is no answer file: its first line must be {','.join(_COLUMNS)}, followed by rows"
        )
    if any(None in row or None in row.values() for row in rows):
        raise AwError(f"{path} has a row with too few or too many cells: ask the rater to save again")
    for column in ("study", "rater", "name"):
        if len({row[column] for row in rows}) > 1:
            raise AwError(f"{path} contains more than one {column}: give one file per rater")
    # the page writes '=x for a name =x, so that spreadsheets do not calculate it
    name = rows[0]["name"]
    name = name[1:] if name[:1] == "'" and name[1:].lstrip()[:1] in ("=", "+", "-", "@") else name
    return {"study": rows[0]["study"], "rater": rows[0]["rater"], "name": name, "answers": rows}


def _answer(path: Path, row: Any, key: Key) -> Answer:
    if not isinstance(row, dict):
        raise AwError(f"{path} is malformed: {quoted(row)} is no answer")
    question, answer = row.get("question"), row.get("answer")
    entry = key.questions.get(question) if isinstance(question, str) else None
    if entry is None:
        raise AwError(f"{path} answers a question that is not in the study: {quoted(question)}")
    choices = CHOICES[entry["kind"]]
    if not isinstance(answer, str) or answer not in choices:
        raise AwError(f"{path} answers {quoted(answer)} to {question}; allowed: {', '.join(choices)}")
    left = row.get("left") or ""
    if left not in (("x", "y") if entry["kind"] == KIND_PAIR else ("",)):
        raise _edited(path, f"has {quoted(left)} as the left image of {question}")
    try:
        seconds = -1.0 if isinstance(row.get("ms"), bool) else float(row.get("ms")) / 1000  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        seconds = -1.0
    if not 0 <= seconds < 1e7:
        raise AwError(f"{path} has no valid time for {question} ({quoted(row.get('ms'))}): it was edited")
    shown = row.get("outline")
    if not isinstance(shown, (str, bool, type(None))) or shown not in OUTLINES:
        raise _edited(path, f"has {quoted(shown)} as outline of {question}")
    return Answer(str(question), answer, left, seconds, seconds < TOO_FAST_S[entry["kind"]], OUTLINES[shown])


def _edited(path: Path, what: str) -> AwError:
    return AwError(f"{path} {what}: it was edited; ask the rater to save again")
