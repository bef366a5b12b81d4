"""What a release says of itself agrees."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import yaml

from ambiguous_wild import __version__

ROOT = Path(__file__).resolve().parents[2]


def test_version_licence_and_changes_agree() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert citation["version"] == __version__
    assert citation["license"] == project["license"]
    assert {"cff-version", "message", "title", "authors", "type"} <= citation.keys()
    versions = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert versions[0] == "Unreleased" and versions[1] == __version__


def test_every_dependency_has_a_tested_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pinned = {
        line.partition("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
        if "==" in line
    }
    asked = [re.split(r"[<>=\[ ]", text)[0].lower().replace("_", "-") for text in project["dependencies"]]
    assert [name for name in asked if name not in pinned] == []
