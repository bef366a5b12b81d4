"""Methods are found by name, from three places."""

import pytest

from ambiguous_wild.core.errors import AwError
from ambiguous_wild.methods import MethodEntry, all_methods, get_method, load_plugin, register, registry


@pytest.fixture(autouse=True)
def _forget_registrations(monkeypatch):
    monkeypatch.setattr(registry, "_registered", {})


def test_builtin_methods_build_with_their_defaults():
    for entry in registry.BUILTIN:
        parts = entry.build(entry.options())
        assert parts.density_config.start < parts.density_config.stop


def test_a_misspelt_method_names_the_nearest():
    with pytest.raises(AwError, match="did you mean 'refinesplat'"):
        get_method("refinsplat")


@pytest.mark.parametrize("name", ["", "a/b", "../x", ".hidden", "a\\b"])
def test_names_that_cannot_be_folders_are_refused(name):
    with pytest.raises(AwError, match="folder"):
        register(MethodEntry(name, "", "m:f"))


def test_a_plugin_file_adds_a_method(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "from ambiguous_wild.methods import MethodEntry, register\n"
        "register(MethodEntry('mine', 'my own', 'ambiguous_wild.methods.threedgs:build'))\n"
    )
    assert load_plugin(path) == ["mine"]
    assert all_methods()["mine"].summary == "my own"


def test_a_plugin_that_registers_nothing_is_refused(tmp_path):
    (tmp_path / "empty.py").write_text("x = 1\n")
    with pytest.raises(AwError, match="registers no method"):
        load_plugin(tmp_path / "empty.py")
    with pytest.raises(AwError, match="no plugin file"):
        load_plugin(tmp_path / "absent.py")


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("x = 1\ndef broken(:\n", "line 2"),
        ("import nothing_of_that_name\n", "line 1, fails when it is loaded: ModuleNotFoundError"),
        ("import sys\nsys.exit(0)\n", "line 2, fails when it is loaded: SystemExit"),
    ],
)
def test_a_plugin_that_does_not_load_is_one_line_that_names_the_place(tmp_path, code, message):
    (tmp_path / "bad.py").write_text(code)
    with pytest.raises(AwError, match=message):
        load_plugin(tmp_path / "bad.py")


def test_a_changed_plugin_is_another_configuration(tmp_path):
    path, hashes = tmp_path / "mine.py", []
    for summary in ("first", "second"):
        path.write_text(
            "from ambiguous_wild.methods import MethodEntry, register\n"
            f"register(MethodEntry('mine', '{summary}', 'ambiguous_wild.methods.threedgs:build'))\n"
        )
        load_plugin(path)
        hashes.append(get_method("mine").source_hash)
    assert len(set(hashes)) == 2
    assert get_method("3dgs").source_hash == ""
