"""The command an error names is one that works here."""

import shlex
from pathlib import Path

from ambiguous_wild.core import errors


def test_from_a_checkout_the_command_installs_the_checkout():
    words = shlex.split(errors.install_command("cuda"))
    root = Path(__file__).parents[2]
    assert words[1:4] == ["-m", "pip", "install"]
    assert words[-1] == f"{root}[cuda]"
    assert words[words.index("-c") + 1] == str(root / "constraints.txt")


def test_installed_as_a_package_the_command_names_the_package(monkeypatch, tmp_path):
    monkeypatch.setattr(
        errors, "__file__", str(tmp_path / "site-packages" / "ambiguous_wild" / "core" / "x.py")
    )
    assert shlex.split(errors.install_command("masks"))[-1] == "ambiguous-wild[masks]"
