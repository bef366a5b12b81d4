"""Methods are found by name, from three places."""

import sys

import pytest

from ambiguous_wild.core.config import with_options
from ambiguous_wild.core.errors import AwError
from ambiguous_wild.methods import MethodEntry, all_methods, get_method, load_plugin, register, registry
from ambiguous_wild.methods.entry import NoOptions
from ambiguous_wild.splat.method_hooks import MethodHooks


def test_builtin_methods_build_with_their_defaults():
    for entry in registry.BUILTIN:
        parts = entry.build(entry.options())
        assert parts.density_config.start < parts.density_config.stop


@pytest.mark.parametrize("name", ["", "a/b", "../x", ".hidden", "a\\b", "-rf", "evil<b>", "a|b", "a\nb"])
def test_names_that_are_no_names_are_refused_where_methods_are_registered(name):
    with pytest.raises(AwError, match="method name") as caught:
        register(MethodEntry(name, "", "m:f"))
    assert "\n" not in str(caught.value) and name not in registry.registered


def test_a_plugin_file_adds_a_method(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(
        "from ambiguous_wild.methods import MethodEntry, register\n"
        "register(MethodEntry('mine', 'my own', 'ambiguous_wild.methods.threedgs:build'))\n"
    )
    assert load_plugin(path) == ["mine"]
    assert all_methods()["mine"].summary == "my own"


def test_a_plugin_imports_what_lies_beside_it_also_later(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "own_masks_of_mine.py").write_text("BUILD = 'ambiguous_wild.methods.threedgs:build'\n")
    (folder / "own_late_of_mine.py").write_text("NUMBER = 7\n")
    (folder / "json.py").write_text("raise RuntimeError('hides the module of Python')\n")
    (folder / "reg.py").write_text(
        "from own_masks_of_mine import BUILD\n"
        "from ambiguous_wild.methods import MethodEntry, register\n"
        "register(MethodEntry('mine', 'my own', BUILD))\n"
        "def late():\n    from own_late_of_mine import NUMBER\n    return NUMBER\n"
    )
    monkeypatch.chdir(tmp_path)
    assert load_plugin("mine/reg.py") == ["mine"]
    assert sys.modules["aw_plugin_reg"].late() == 7
    assert sys.path[0] != str(folder) and sys.path[-1] == str(folder)  # later it hides nothing
    for name in ("own_masks_of_mine", "own_late_of_mine"):
        sys.modules.pop(name)


def test_a_recipe_in_a_file_is_a_plugin(tmp_path):
    (tmp_path / "mine.py").write_text(
        "from dataclasses import dataclass\n"
        "from ambiguous_wild.splat.method_hooks import MethodHooks\n"
        "@dataclass(frozen=True)\nclass Options:\n    share: float = 0.5\n"
        "def mine(options: Options):\n    return MethodHooks()\n"
    )
    assert load_plugin(f"{tmp_path}/mine.py:mine") == ["mine"] and get_method("mine").source_hash


def test_a_plugin_that_registers_nothing_is_refused(tmp_path):
    (tmp_path / "empty.py").write_text("x = 1\n")
    with pytest.raises(AwError, match="registers no method"):
        load_plugin(tmp_path / "empty.py")


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("x = 1\ndef broken(:\n", "line 2"),
        (
            "import nothing_of_that_name\n",
            r"fails when it is loaded: ModuleNotFoundError: .* \(bad.py, line 1\)",
        ),
        ("import sys\nsys.exit(0)\n", r"fails when it is loaded: SystemExit: 0 \(bad.py, line 2\)"),
        (
            "from ambiguous_wild import methods\nmethods.register(methods.MethodEntry('3DGS', '', 'm:f'))\n",
            r"plugin .*bad\.py: the method '3DGS' is built in: register yours under another name",
        ),
    ],
)
def test_a_plugin_that_does_not_load_is_one_line_that_names_the_place(tmp_path, code, message):
    (tmp_path / "bad.py").write_text(code)
    with pytest.raises(AwError, match=message):
        load_plugin(tmp_path / "bad.py")


def test_a_recipe_without_options_may_take_nothing():
    for recipe in (lambda: MethodHooks(sh_degree=2), lambda *any: MethodHooks(sh_degree=2 + len(any))):
        assert MethodEntry("none", "", recipe).build(NoOptions()).sh_degree == 2
    with pytest.raises(AwError, match="the recipe of two takes a, b: it must take nothing, or one"):
        MethodEntry("two", "", lambda a, b: MethodHooks()).build(None)


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


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("3dgs", False),
        ("refinesplat", False),
        ("3dgs@mask=refinesplat", False),
        ("3dgs+truth", True),
        ("3dgs-clean", True),
        ("refinesplat@mask=truth", True),
        ("3dgs@mask=3dgs+truth,density=refinesplat", True),
        ("3dgs+truth@density=refinesplat", True),
        ("3dgs-clean@mask=refinesplat", True),
        ("3dgs+truth@mask=refinesplat", False),  # nothing of the truth is left
        ("3dgs@density=3dgs+truth", False),  # its density control is 3DGS's
    ],
)
def test_who_is_shown_the_truth(name, known):
    get_method(name)
    assert registry.knows_truth(name) is known


def test_an_option_without_a_default_is_named(tmp_path):
    path = tmp_path / "bare.py"
    path.write_text(
        "from dataclasses import dataclass\nfrom ambiguous_wild.methods import MethodEntry, register\n"
        "@dataclass(frozen=True)\nclass Config:\n    factor: float\n    near: float = 1.0\n"
        "register(MethodEntry('bare', '', lambda options: None, config=Config))\n"
    )
    load_plugin(path)
    with pytest.raises(AwError, match="factor of Config has none: write factor"):
        get_method("bare").options()


@pytest.mark.parametrize(
    ("method", "option", "message"),
    [
        ("refinesplat", "features=dinov2-smal", "did you mean 'dinov2-small'"),
        ("refinesplat", "instances=grahp", "did you mean 'graph'"),
        ("robustsplat", "features=dinov2-smal@504,normalise=raw", "did you mean 'dinov2-small"),
        ("dronesplat", "instances=sam3", "did you mean 'sam"),
        ("3dgs@mask=refinesplat", "mask.features=labhogg", "did you mean 'labhog'"),
        ("refinesplat", "density.support.every=0", "refinesplat.density.support.every is at least 1, got 0"),
        ("refinesplat", "density.merge.neighbours=0", "neighbours is at least 1"),
        ("refinesplat", "density.merge.most=1", "at least 2, got 1"),
        ("refinesplat", "density.every=-1", "density.every is at least"),
        ("refinesplat", "density.decides=entropy", "both entropy losses are off"),
        ("refinesplat", "mask.box=0", "refinesplat.mask.box is at least 1, got 0"),
        ("refinesplat", "mask.dilation=4", "refinesplat.mask.dilation is an odd number, got 4"),
        ("refinesplat", "mask.w2=2", "refinesplat.mask.w2 is from 0 to 1, got 2"),
        ("refinesplat", "mask.memory=2", "mask.memory is from 0 to 1"),
        ("refinesplat", "mask.multiview.quantile=2", "multiview.quantile is from 0 to 1, got 2"),
        ("refinesplat", "first_look.quantile=2", "first_look.quantile is from 0 to 1, got 2"),
        ("refinesplat", "psi.hidden=0", "psi.hidden is at least 1"),
        ("refinesplat", "psi.rate=-1", "psi.rate is at least"),
        ("refinesplat", "segments.k=0", "segments.k is at least"),
        ("refinesplat", "lr_opacity=-1", "lr_opacity is at least"),
        ("robustsplat", "density.max_gaussians=0", "density.max_gaussians is at least 1"),
    ],
)
def test_options_that_mean_nothing_are_refused_before_anything_trains(method, option, message):
    key, _, value = option.partition("=")
    with pytest.raises(AwError, match=message):
        with_options(get_method(method).options(), {key: value})


def test_back_ends_with_options_of_their_own_are_options():
    spec = "dinov2-small-registers@504,normalise=raw"
    assert with_options(get_method("robustsplat").options(), {"features": spec}).features == spec
    labels = "labels:masks/ids,scene_wide=true"
    assert with_options(get_method("refinesplat").options(), {"instances": labels}).instances == labels
