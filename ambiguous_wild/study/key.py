"""The key of a study: the method of each image."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from ambiguous_wild.core import AwError
from ambiguous_wild.core.names import is_text

FORMAT, VERSION = "aw-study-key", 1
KIND_PHOTO: Final = "ambiguity"
KIND_PAIR: Final = "preference"
_FIELDS = {KIND_PHOTO: ("scene", "view"), KIND_PAIR: ("scene", "view", "x", "y")}


@dataclass(frozen=True)
class Key:
    """What is needed to score answers."""

    study: str  # id of the study
    title: str
    questions: dict[str, dict[str, str]]  # token -> kind, scene, view and, for pairs, the methods x and y


def study_id(*parts: Any) -> str:
    """Hash of `parts`, 16 hexadecimal digits."""
    text = json.dumps(parts, sort_keys=True, ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_key(path: Path) -> Key:
    """Read and check a key.

    Raises:
        AwError: unreadable, not a key, of another version, or damaged.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise AwError(
            f"cannot read the key {path}: {error.strerror}; 'aw study make' wrote it next to the page"
        ) from None
    except (ValueError, RecursionError) as error:
        raise AwError(
            f"the key {path} is damaged ({error}); use the one that 'aw study make' wrote"
        ) from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise AwError(f"{path} is no key of a study; 'aw study make' wrote it next to the page (*.key.json)")
    if data.get("version") != VERSION:
        raise AwError(
            f"the key {path} has version {data.get('version')!r}, this program reads {VERSION}; update it"
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
        raise AwError(
            f"the key {path} is damaged (a field is missing); use the one that 'aw study make' wrote"
        )
    if not is_text(json.dumps(data, ensure_ascii=False)):
        raise AwError(f"the key {path} is damaged (half a character); use the one that 'aw study make' wrote")
    return Key(data["study"], data["title"], data["questions"])


def _complete(entry: Any) -> bool:
    kind = entry.get("kind") if isinstance(entry, dict) else None
    if not isinstance(kind, str) or kind not in _FIELDS:
        return False
    return all(isinstance(entry.get(field), str) for field in _FIELDS[kind])
