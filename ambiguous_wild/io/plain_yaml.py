"""YAML of plain data: no tags, no aliases, no repeated keys, limited size."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.io import untrusted

LARGEST = 1_000_000  # bytes; our files have a few thousand
DEEPEST = 50  # nested lists and mappings
LONGEST_NUMBER = 400  # characters of a whole number; no float is larger


class PlainLoader(yaml.SafeLoader):
    """YAML's safe loader, without repeated keys and aliases."""

    _depth = 0  # of the node being composed

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise AwError(f"line {self.peek_event().start_mark.line + 1}: aliases (*name) are not supported")
        self._depth += 1
        if self._depth > DEEPEST:
            raise AwError(f"line {self.peek_event().start_mark.line + 1}: nested deeper than {DEEPEST}")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key.value, str):
                raise AwError(
                    f"not YAML that is supported: the key in line {key.start_mark.line + 1} is no text"
                )
            if key.tag == "tag:yaml.org,2002:merge":
                raise AwError(f"line {key.start_mark.line + 1}: merged keys (<<) are not supported")
            if key.value in seen:
                raise AwError(f"line {key.start_mark.line + 1}: the key {key.value!r} occurs twice")
            seen.add(key.value)
        return super().construct_mapping(node, deep)

    def construct_yaml_int(self, node: Any) -> int:
        # Python limits decimal numbers only, not 0xfff... and 1:59:59..., and cannot print such values.
        if len(node.value) > LONGEST_NUMBER:
            raise AwError(
                f"line {node.start_mark.line + 1}: a whole number of {len(node.value)} characters is too long"
            )
        return int(super().construct_yaml_int(node))


PlainLoader.add_constructor("tag:yaml.org,2002:int", PlainLoader.construct_yaml_int)


def parse(text: str) -> Any:
    """Parse a YAML text into plain data.

    Raises:
        AwError: no YAML, or something that is not supported; the message names the line.
    """
    try:
        return yaml.load(text, Loader=PlainLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        problem = " ".join(str(getattr(error, "problem", None) or "it does not parse").split())
        raise AwError(f"not YAML{line}: {problem}") from None
    # PyYAML raises these for 2025-99-99, numbers of ten thousand digits, a thousand brackets, and some bugs.
    except (ValueError, TypeError, RecursionError, KeyError, AttributeError, IndexError) as error:
        raise AwError(f"not YAML that is supported: {error or type(error).__name__}") from None


def read_text(path: Path) -> str:
    """Read the text of a YAML file.

    Raises:
        AwError: it cannot be read, is no UTF-8, or too large.
    """
    return untrusted.read_text(path, LARGEST)


def read_mapping(path: Path) -> dict[Any, Any]:
    """Read a file that holds one mapping.

    Raises:
        AwError: it cannot be read, or holds something else.
    """
    try:
        data = parse(read_text(path))
    except AwError as error:
        raise AwError(f"{path} is damaged ({error})") from None
    if not isinstance(data, dict):
        raise AwError(f"{path} is damaged (no 'key: value' lines)")
    return data
