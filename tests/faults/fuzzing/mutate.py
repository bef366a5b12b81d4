"""Seeded damage: bytes anywhere, numbers in headers, nodes of JSON and YAML."""

from __future__ import annotations

import copy
import json
import random
import struct
import zlib
from collections.abc import Callable
from typing import Any

_INTS = (0, 1, 2, 16, 255, 256, 32767, 65535, 10**5, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**63 - 1,
         2**64 - 1)  # fmt: skip
_WORDS = ("nan", "inf", "-inf", "-1", "0", "1e999", "-0.0", "1e-320", "9" * 30, '""', "null", "true", "[]",
          "{}", "../../x", "/etc/passwd", "\0", "\ufeff", "é", "\ud7ff", "#", ",", "\n", "\t", '"', "'",
          "[" * 2000, "{" * 500, "a: " * 50, "=cmd()", "&a *a", "!!python/object/apply:os.system ['true']",
          "x" * 5000)  # fmt: skip
_NODES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 3, 2**63, 10**400, 1e308, -1e308, 5e-324, float("nan"), float("inf"), "",
    "x", "../x", "/x", "\0", "inf", "x" * 3000, [], {}, [[]], [None], {"": None}, {"a": {}}, [1, 2, 3],
)  # fmt: skip


def damage(data: bytes, dice: random.Random, other: bytes) -> bytes:
    """Apply one to six mutations; `other` is another valid file of the same type."""
    out = bytearray(data)
    for _ in range(dice.choice((1, 1, 1, 2, 3, 6))):
        dice.choice(_STROKES)(out, dice, other)
    return bytes(out)


def _flip(out: bytearray, dice: random.Random, other: bytes) -> None:
    for _ in range(dice.choice((1, 1, 4, 30))):
        if out:
            out[_place(out, dice)] ^= 1 << dice.randrange(8)


def _byte(out: bytearray, dice: random.Random, other: bytes) -> None:
    if out:
        out[_place(out, dice)] = dice.choice((0, 1, 0x7F, 0x80, 0xFF, dice.randrange(256)))


def _cut(out: bytearray, dice: random.Random, other: bytes) -> None:
    del out[dice.randrange(len(out) + 1) :]


def _remove(out: bytearray, dice: random.Random, other: bytes) -> None:
    at = dice.randrange(len(out) + 1)
    del out[at : at + dice.choice((1, 2, 4, 8, 100, 1000))]


def _insert(out: bytearray, dice: random.Random, other: bytes) -> None:
    at = dice.randrange(len(out) + 1)
    chunk = dice.choice((bytes(64), b"\xff" * 64, dice.randbytes(dice.choice((1, 2, 4, 8, 100)))))
    out[at:at] = chunk


def _repeat(out: bytearray, dice: random.Random, other: bytes) -> None:
    at = dice.randrange(len(out) + 1)
    out[at:at] = out[at : at + dice.choice((4, 30, 500))] * dice.choice((1, 3, 20))


def _number(out: bytearray, dice: random.Random, other: bytes) -> None:
    size, layout = dice.choice(((2, "H"), (4, "I"), (8, "Q"), (8, "d"), (4, "f")))
    if len(out) < size:
        return
    at = _place(out, dice) % (len(out) - size + 1)
    if layout in "df":
        value: Any = dice.choice((0.0, -1.0, float("nan"), float("inf"), 1e38, 1e-40))
    else:
        value = dice.choice(_INTS) % 2 ** (8 * size)
    out[at : at + size] = struct.pack(dice.choice("<>") + layout, value)


def _word(out: bytearray, dice: random.Random, other: bytes) -> None:
    """Replace or insert one word of a text."""
    at = dice.randrange(len(out) + 1)
    end = at
    while end < len(out) and out[end] not in b" \n,:\"'{}[]":
        end += 1
    out[at : end if dice.random() < 0.7 else at] = dice.choice(_WORDS).encode()


def _splice(out: bytearray, dice: random.Random, other: bytes) -> None:
    out[dice.randrange(len(out) + 1) :] = other[dice.randrange(len(other) + 1) :]


_STROKES: tuple[Callable[[bytearray, random.Random, bytes], None], ...] = (
    _flip, _flip, _byte, _cut, _remove, _insert, _repeat, _number, _number, _number, _word, _splice,
)  # fmt: skip


def _place(out: bytearray, dice: random.Random) -> int:
    """A position; half of them are in the first hundred bytes, since headers decide allocations."""
    return dice.randrange(min(len(out), 100) if dice.random() < 0.5 else len(out))


def png(data: bytes, dice: random.Random, other: bytes) -> bytes:
    """Damage a PNG; half the time with correct checksums, so that the damage is read."""
    out = bytearray(damage(data, dice, other))
    at = 8
    while dice.random() < 0.9 and at + 12 <= len(out):
        length = int.from_bytes(out[at : at + 4], "big")
        if at + 12 + length > len(out):
            break
        struct.pack_into(">I", out, at + 8 + length, zlib.crc32(out[at + 4 : at + 8 + length]))
        at += 12 + length
    return bytes(out)


def exif(data: bytes, dice: random.Random, other: bytes) -> bytes:
    """Damage only the first APP1 segment of a JPEG."""
    start = data.find(b"\xff\xe1")
    size = int.from_bytes(data[start + 2 : start + 4], "big")
    inner = bytearray(data[start + 4 : start + 2 + size])
    for _ in range(dice.choice((1, 2, 4))):
        dice.choice((_flip, _byte, _number, _number))(inner, dice, other)
    return data[: start + 4] + bytes(inner) + data[start + 2 + size :]


def tree(load: Callable[[str], Any], dump: Callable[[Any], str]) -> Callable[..., bytes]:
    """Damage a text format: replace, remove or rename one node of its tree; or damage its bytes."""

    def mutate(data: bytes, dice: random.Random, other: bytes) -> bytes:
        if dice.random() < 0.4:
            return damage(data, dice, other)
        root = load(data.decode())
        for _ in range(dice.choice((1, 1, 2, 5))):
            root = _changed(root, dice)
        try:
            return dump(root).encode("utf-8", errors="surrogatepass")
        except ValueError:  # a number the format has no word for
            return damage(data, dice, other)

    return mutate


def _changed(root: Any, dice: random.Random) -> Any:
    spots = list(_spots(root))
    if not spots:
        return copy.deepcopy(dice.choice(_NODES))
    owner, key = dice.choice(spots)
    stroke = dice.random()
    if stroke < 0.75:
        owner[key] = copy.deepcopy(dice.choice(_NODES))
    elif stroke < 0.9:
        del owner[key]
    elif isinstance(owner, dict):
        owner[str(key) + "x"] = owner.pop(key)
    else:
        owner.append(copy.deepcopy(owner[key]))
    return root


def _spots(node: Any) -> Any:
    pairs = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in pairs:
        yield node, key
        yield from _spots(value)


json_tree = tree(json.loads, json.dumps)
