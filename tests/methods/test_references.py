"""A method named by where it lies: `recipe.py:my_recipe`."""

import hashlib
import sys

import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.job import read_sources
from ambiguous_wild.methods import registry
from ambiguous_wild.methods.graft import graft_name, replace_reference_files
from ambiguous_wild.methods.references import import_file, reference_file

CODE = r'''
from dataclasses import dataclass
from ambiguous_wild.methods import MethodEntry
from ambiguous_wild.splat.method_hooks import MethodHooks

@dataclass(frozen=True)
class Config:
    sh_degree: int = 2

def plain():
    """As it comes.

    More of it."""
    return MethodHooks()

def tuned(config: Config):
    return MethodHooks(sh_degree=config.sh_degree)

def untyped(config):
    return MethodHooks()

def wrong(config: "Nowhere"):
    return MethodHooks()

def three():
    return 3

def nothing():
    MethodHooks()

entry = MethodEntry("its-own-name", "made by hand", tuned, config=Config)
annotated = MethodEntry("annotated", "made by hand", tuned)
number = 3
'''


@pytest.fixture
def recipe(tmp_path):
    (tmp_path / "recipe.py").write_text(CODE)
    return tmp_path / "recipe.py"


def test_a_function_without_options(recipe):
    entry = registry.get_method(f"{recipe}:plain")
    assert (entry.name, entry.summary) == ("plain", "As it comes.")
    assert entry.build(entry.options()).sh_degree == 3
    assert registry.get_method("plain").source_hash == entry.source_hash  # its name finds it from now on


def test_a_function_with_options_and_an_entry(recipe):
    for name, called in (("tuned", "tuned"), ("entry", "its-own-name"), ("annotated", "annotated")):
        entry = registry.get_method(f"{recipe}:{name}")
        assert entry.name == called
        assert entry.options().sh_degree == 2
        assert entry.build(entry.options()).sh_degree == 2


def test_a_changed_file_is_another_method(recipe):
    before = registry.get_method(f"{recipe}:plain").source_hash
    recipe.write_text(CODE + "# changed\n")
    other = recipe.with_name("other.py")
    other.write_text(CODE + "# changed\n")
    with pytest.raises(AwError, match="so is another method"):
        registry.get_method(f"{other}:plain")
    assert registry.get_method(f"{recipe}:plain").source_hash != before  # of the same file, as in a notebook


def test_a_changed_helper_is_another_method(recipe, tmp_path, monkeypatch):
    """Its hash depends on neither what was loaded before nor packages installed below the folder."""
    alone = registry.get_method(f"{recipe}:plain").source_hash
    assert alone == hashlib.sha256(recipe.read_bytes()).hexdigest()
    monkeypatch.syspath_prepend(tmp_path / "lib" / "site-packages")
    monkeypatch.syspath_prepend(tmp_path)
    for name in (
        "bench_helpers/inner.py",
        "bench_helpers/__init__.py",
        "lib/site-packages/bench_installed.py",
    ):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("degree = 1\n")
    recipe.write_text("import bench_installed\nfrom bench_helpers.inner import degree\n" + CODE)
    (tmp_path / "sibling.py").write_text("import bench_helpers.inner\n" + CODE)
    hashes = []
    for degree in (1, 10):
        (tmp_path / "bench_helpers" / "inner.py").write_text(f"degree = {degree}\n")
        assert len({registry.get_method(f"{recipe}:{name}").source_hash for name in ("plain", "tuned")}) == 1
        hashes.append(registry.get_method(f"{recipe}:plain").source_hash)
        import_file(tmp_path / "sibling.py")
        hashes.append(registry.get_method(f"{recipe}:plain").source_hash)
        loaded = [m for m in list(sys.modules.values()) if getattr(m, "__file__", None) == str(recipe)]
        assert [module.degree for module in loaded] == [degree]
    (tmp_path / "lib/site-packages/bench_installed.py").write_text("degree = 1000\n")
    hashes.append(registry.get_method(f"{recipe}:plain").source_hash)
    assert hashes[0] == hashes[1] != hashes[2] == hashes[3] == hashes[4] and alone not in hashes


def test_a_helper_that_is_imported_in_a_function_belongs_to_the_hash(recipe, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    recipe.write_text(CODE + "\n\ndef later():\n    import late_helper\n    return late_helper\n")
    hashes = []
    for text in ("k = 1\n", "k = 100\n"):
        (tmp_path / "late_helper.py").write_text(text)
        hashes.append(registry.get_method(f"{recipe}:plain").source_hash)
    assert hashes[0] != hashes[1]


def test_two_files_have_a_helper_of_one_name(tmp_path):
    code = "import os, sys\nsys.path.insert(0, os.path.dirname(__file__))\nfrom name_shared import k\n"
    modules = {}
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "name_shared.py").write_text(f"k = {name!r}\n")
        (tmp_path / name / "plug.py").write_text(code)
        modules[name] = import_file(tmp_path / name / "plug.py")[0]
    assert [module.k for module in modules.values()] == ["a", "b"]
    assert len({module.__name__ for module in modules.values()}) == 2


def test_hashes_do_not_depend_on_the_order_of_loading(recipe, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    other = tmp_path / "other.py"
    for name, path in (("order_one", recipe), ("order_two", other)):
        (tmp_path / f"{name}.py").write_text("degree = 1\n")
        path.write_text(f"import {name}\n" + CODE)
    loaded = [[import_file(path)[1] for path in order] for order in ((recipe, other), (other, recipe))]
    assert loaded[0] == loaded[1][::-1] and len(set(loaded[0])) == 2


def test_it_is_a_host_of_grafts(recipe):
    entry = registry.get_method(f"{recipe}:plain@mask=truth")
    assert entry.name == "plain@mask=truth"
    assert graft_name(f"{recipe}:plain", {"mask": "truth"}) == f"{recipe}:plain@mask=truth"


def test_an_at_in_a_path_is_no_graft(tmp_path):
    (tmp_path / "a@b").mkdir()
    (tmp_path / "a@b" / "recipe.py").write_text(CODE)
    host = f"{tmp_path}/a@b/recipe.py:plain"
    assert graft_name(host, {"mask": "truth"}) == f"{host}@mask=truth"
    assert registry.get_method(f"{host}@mask=truth").name == "plain@mask=truth"


@pytest.mark.parametrize(("name", "what"), [("three", "int"), ("nothing", "None")])
def test_what_returns_no_parts_is_said_so(recipe, name, what):
    entry = registry.get_method(f"{recipe}:{name}")
    with pytest.raises(AwError, match=f"{name} returned {what}, it must return MethodHooks"):
        entry.build(entry.options())


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("plian", "did you mean 'plain'"),
        ("number", "is a int"),
        ("untyped", "one argument whose type is a dataclass"),
        ("wrong", "in the types of its arguments"),
    ],
)
def test_what_is_no_recipe_is_one_clear_line(recipe, name, message):
    with pytest.raises(AwError, match=message):
        registry.get_method(f"{recipe}:{name}")


def test_a_file_that_is_not_there_or_is_broken(recipe, tmp_path):
    with pytest.raises(AwError, match="no plugin file"):
        registry.get_method(f"{tmp_path}/absent.py:plain")
    recipe.write_text("x = (")
    with pytest.raises(AwError, match=r"recipe.py, line 1"):
        registry.get_method(f"{recipe}:plain")


def test_a_donor_may_be_a_recipe_in_a_file(recipe):
    entry = registry.get_method(f"refinesplat@mask={recipe}:plain")
    assert entry.name == "refinesplat@mask=plain"
    assert entry.given_as == f"refinesplat@mask={recipe.resolve()}:plain"
    assert registry.get_method(entry.given_as).source_hash == entry.source_hash != ""
    ((text, kind),) = [(source.text, source.kind) for source in read_sources([], [entry.given_as])]
    assert (text, kind) == (f"{recipe.resolve()}:plain", "method")
    with pytest.raises(AwError, match="no plugin file"):
        registry.get_method("3dgs@mask=nowhere.py:mine")


def test_a_description_of_the_package_is_named_alike_from_every_folder(tmp_path, monkeypatch):
    name = "external:opensplat"
    (tmp_path / "opensplat").write_text("a program")  # no description, though it is called so
    monkeypatch.chdir(tmp_path)
    entry = registry.get_method(name)
    assert entry.name == "opensplat" and entry.given_as == name and reference_file(name) is None
    assert replace_reference_files(f"{name}+2passes", lambda path: tmp_path / path) == f"{name}+2passes"
    ((text, path),) = [(source.text, source.path) for source in read_sources([], [name])]
    assert (text, path) == (name, "")
    (tmp_path / "mine").write_text("name: mine\ntrain: x\nrenders: '{stem}'\n")
    assert registry.get_method("external:mine").given_as == f"external:{tmp_path / 'mine'}"
