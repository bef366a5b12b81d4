"""Plug and play: places of one method filled by another, by name, by option and in the table."""

import json
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner

from ambiguous_wild.cli.bench import command as bench
from ambiguous_wild.cli.table import command as table
from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import with_options
from ambiguous_wild.harness.running.grid import plan_cells
from ambiguous_wild.methods import MethodEntry, get_method, register, registry
from ambiguous_wild.methods.graft import compose, graft_name, idle_regulariser
from ambiguous_wild.methods.grafted_policy import GraftedPolicy
from ambiguous_wild.methods.refinesplat.density import EntropyAwareDensity
from ambiguous_wild.methods.refinesplat.policy import RefineSplatMask
from ambiguous_wild.methods.robustsplat.config import RobustSplatConfig
from ambiguous_wild.methods.robustsplat.policy import RobustSplatMask
from ambiguous_wild.methods.truth import TruthMask
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.effects.exposure import AffineExposure
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.parts import MaskPolicy, Parts
from tests.methods.baselines import bits, parts_of, resumed_equals_whole, trained
from tests.tiny_scene import write_tiny_scene

TRUE_3DGS = "3dgs@mask=truth"


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return write_tiny_scene(tmp_path_factory.mktemp("data") / "scene")


def run(command, *arguments):
    return CliRunner().invoke(command, [str(a) for a in arguments])


# -- names --------------------------------------------------------------------------------------------


def test_one_graft_has_one_name():
    donors = {"regulariser": "refinesplat", "density": None, "mask": "truth"}
    name = "robustsplat@mask=truth,regulariser=refinesplat"
    assert graft_name("robustsplat", donors) == name
    assert get_method("robustsplat@regulariser=refinesplat, mask=truth").name == name
    assert graft_name("3dgs", {"mask": None}) == "3dgs"
    assert graft_name("3dgs@mask=none", {"mask": "truth"}) == "3dgs@mask=truth"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("3dgs@mask=refinsplat", "did you mean 'refinesplat'"),
        ("3dgs@masks=refinesplat", "did you mean 'mask'"),
        ("3gds@mask=refinesplat", "did you mean '3dgs'"),
        ("3dgs@mask", "write 3dgs@mask=METHOD"),
        ("3dgs@mask=", "write 3dgs@mask=METHOD"),
        ("3dgs@", "write 3dgs@mask=METHOD"),
        ("3dgs@mask=none@mask=truth", "with one @"),
        ("3dgs@mask=truth,mask=none", "given twice"),
    ],
)
def test_names_that_mean_nothing_are_refused(name, message):
    with pytest.raises(AwError, match=message):
        get_method(name)


# -- what fills which place ---------------------------------------------------------------------------


def test_places_come_from_their_donors_and_the_rest_from_the_host():
    parts = parts_of("robustsplat@mask=refinesplat,density=refinesplat")
    assert isinstance(parts.mask, GraftedPolicy)
    assert isinstance(parts.mask.mask, RefineSplatMask)
    assert parts.mask.regulariser is None  # the host has none, and the donor's was not asked for
    assert parts.density is EntropyAwareDensity
    assert parts.weighting == "images"
    assert parts.schedule.lr_opacity == 0.025

    parts = parts_of("refinesplat@mask=truth")
    assert isinstance(parts.mask.mask, TruthMask)
    own = parts_of("refinesplat@mask=truth", **{"host.lambda_cr": "0.2"}).mask.regulariser
    assert isinstance(own, RefineSplatMask)  # the host's own stays, where it has one
    assert parts.density is EntropyAwareDensity
    assert type(parts_of("refinesplat@mask=none").mask.mask) is MaskPolicy
    assert parts_of("refinesplat@density=3dgs").density is DensityControl


def test_a_method_in_two_places_is_built_once_unless_its_options_differ():
    assert isinstance(parts_of("refinesplat@mask=refinesplat").mask, RefineSplatMask)
    both = get_method("3dgs@mask=refinesplat,regulariser=refinesplat")
    assert isinstance(both.build(both.options()).mask, RefineSplatMask)
    options = with_options(both.options(), {"mask.mask.gate": "9"})
    policy = both.build(options).mask
    assert policy.mask is not policy.regulariser
    assert policy.mask.config.mask.gate == 9.0


def test_settings_reach_host_and_donors_by_their_names(scene):
    name = "refinesplat@mask=robustsplat,density=robustsplat"
    settings = ["robustsplat.erosion=5", "refinesplat.mask_every=2", "robustsplat.density.every=50"]
    train = TrainConfig(iterations=5)
    (cell,) = plan_cells([name], [scene], [0], train, settings=settings)
    assert cell.options.host.mask_every == 2
    assert cell.options.mask.erosion == cell.options.density.erosion == 5
    assert cell.method.build(cell.options).density_config.every == 50
    (other,) = plan_cells([name], [scene], [0], train, settings=settings[:2])
    assert cell.identity != other.identity

    cells = plan_cells(["3dgs", TRUE_3DGS], [scene], [0], train, settings=["truth.dilation=2"])
    assert cells[1].options.mask.dilation == 2
    cells = plan_cells([TRUE_3DGS], [scene], [0], train, settings=["3dgs+truth.dilation=3"])
    assert cells[0].options.mask.dilation == 3
    with pytest.raises(AwError, match="did you mean 'robustsplat'"):
        plan_cells([name], [scene], [0], train, settings=["robustplat.erosion=5"])
    with pytest.raises(AwError, match="did you mean 'erosion'"):
        plan_cells([name], [scene], [0], train, settings=["robustsplat.erosoin=5"])


def test_a_donors_plugin_is_part_of_the_identity(monkeypatch):
    monkeypatch.setattr(registry, "_registered", {})
    hashes = []
    for source in ("a", "b"):
        register(MethodEntry("mine", "", "ambiguous_wild.methods.threedgs:build", source_hash=source))
        hashes.append(get_method("refinesplat@mask=mine").source_hash)
    assert len({*hashes, ""}) == 3
    assert get_method("refinesplat@mask=3dgs").source_hash == ""


# -- effects ------------------------------------------------------------------------------------------


@pytest.fixture
def toned(monkeypatch):
    """A method whose recipe brings an effect of its own, an affine exposure per photo."""
    monkeypatch.setattr(registry, "_registered", {})

    def build(options):
        return Parts(mask=RobustSplatMask(RobustSplatConfig()), effects=(AffineExposure(),))

    return register(MethodEntry("toned", "", build))


@pytest.mark.parametrize("place", ["mask", "density", "regulariser"])
def test_a_donors_effects_that_are_left_out_are_named(toned, place):
    with pytest.warns(UserWarning, match=r"leaves out toned's effects \(exposure\): add effects=toned"):
        parts = parts_of(f"3dgs@{place}=toned")
    assert parts.effects == ()


def test_the_effects_of_a_donor_are_taken_where_they_are_asked_for(toned, recwarn):
    parts = parts_of("3dgs@effects=toned, mask=toned")
    assert [effect.name for effect in parts.effects] == ["exposure"]
    assert parts_of("3dgs@mask=toned,effects=none").effects == ()
    assert len(parts_of("toned@mask=3dgs").effects) == 1  # a host's own stay
    assert parts_of("toned@effects=none").effects == ()
    assert len(parts_of("toned@mask=toned").effects) == 1
    assert not recwarn.list


def test_effects_that_are_taken_change_what_they_need_of_the_renderer(monkeypatch):
    monkeypatch.setattr(registry, "_registered", {})
    register(MethodEntry("filtered", "", lambda options: with_effects(Parts(), ["antialias"])))
    assert not parts_of("3dgs").antialias
    parts = parts_of("3dgs@effects=filtered")
    assert parts.antialias and [effect.name for effect in parts.effects] == ["antialias"]


def test_a_graft_trains_with_the_effects_it_takes(toned, scene, tmp_path):
    trainer = trained(scene, tmp_path / "run", parts_of("3dgs@effects=toned"), 8)
    assert trainer.effects is not None and "exposure" in trainer.effects.facts()
    assert bits(trainer) != bits(trained(scene, tmp_path / "plain", Parts(), 8))


# -- runs ---------------------------------------------------------------------------------------------


def test_a_methods_own_mask_changes_no_bit(scene, tmp_path):
    options = {"min_mask_start": "20"}
    own = trained(scene, tmp_path / "own", parts_of("robustsplat", **options), 60)
    both = {f"{place}.{key}": value for place in ("host", "mask") for key, value in options.items()}
    graft = trained(scene, tmp_path / "graft", parts_of("robustsplat@mask=robustsplat", **both), 60)
    assert bits(graft) == bits(own)
    both |= {f"density.{key}": value for key, value in options.items()}
    name = "robustsplat@mask=robustsplat,density=robustsplat"
    assert bits(trained(scene, tmp_path / "density", parts_of(name, **both), 60)) == bits(own)
    # and where it is a second instance of its own, which knows nothing of the host's
    parts = parts_of("robustsplat", **options)
    second = Parts(**{**vars(parts), "mask": GraftedPolicy(RobustSplatMask(parts.mask.config), None)})
    assert bits(trained(scene, tmp_path / "second", second, 60)) == bits(own)


def test_refinesplat_over_refinesplat_is_refinesplat(scene, tmp_path):
    options = {"min_mask_start": "20", "mask_start": "0"}
    own = trained(scene, tmp_path / "own", parts_of("refinesplat", **options), 60)
    grown = {f"{place}.{k}": v for place in ("host", "mask", "density") for k, v in options.items()}
    name = "refinesplat@mask=refinesplat,density=refinesplat"
    assert bits(trained(scene, tmp_path / "graft", parts_of(name, **grown), 60)) == bits(own)
    assert bits(trained(scene, tmp_path / "plain", Parts(), 60)) != bits(own)


def test_a_regulariser_that_adds_nothing_is_told(scene):
    (off, on, none) = (
        plan_cells([f"3dgs@regulariser={donor}"], [scene], [0], TrainConfig(iterations=5), settings=settings)[
            0
        ]
        for donor, settings in (
            ("refinesplat", []),
            ("refinesplat", ["refinesplat.lambda_cr=0.2"]),
            ("none", []),
        )
    )
    assert idle_regulariser(off.method, off.options) == "refinesplat"
    assert idle_regulariser(on.method, on.options) == ""
    assert idle_regulariser(none.method, none.options) == ""
    assert idle_regulariser(get_method("3dgs"), None) == ""


def test_the_regulariser_sees_the_hosts_keep_map():
    seen = []

    class Masks(MaskPolicy):
        def keep(self, step):
            return "kept"

    class Regulariser(MaskPolicy):
        def keep(self, step):
            raise AssertionError("its masks were not asked for")

        def cotangent(self, step, keep):
            seen.append(keep)
            return "cotangent"

    policy = compose(Masks(), Regulariser())
    assert policy.cotangent(None, policy.keep(None)) == "cotangent"
    assert seen == ["kept"]
    assert policy.predict(None) == "kept"
    assert compose(Regulariser(), Masks()).cotangent(None, None) is None  # Masks has no loss of its own


def test_a_resumed_graft_gives_the_same_bits(scene, tmp_path):
    options = {
        "mask.min_mask_start": "20",
        "regulariser.min_mask_start": "20",
        "regulariser.lambda_cr": "0.2",
        "regulariser.lambda_id": "0.01",
        "regulariser.psi.steps": "30",
    }
    name = "3dgs@mask=robustsplat,density=refinesplat,regulariser=refinesplat"
    resumed_equals_whole(scene, tmp_path, lambda: parts_of(name, **options))


def test_grafts_are_ordinary_runs_from_the_command_line(scene, tmp_path):
    arguments = ["--method", "3dgs", "--method", "refinesplat", "--mask", "truth", "--scene", scene]
    arguments += ["--iterations", "12", "-o", tmp_path / "runs", "--no-pictures", "--set", "truth.dilation=1"]
    result = run(bench, *arguments)
    assert result.exit_code == 0, result.output
    folder = Path(tmp_path / "runs" / "scene" / TRUE_3DGS / "seed0")
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["method"] == TRUE_3DGS
    assert metrics["options"] == {"host": {}, "mask": {"dilation": 1}}
    assert metrics["masks"]["recall"] == 1.0
    assert yaml.safe_load((folder / "config.yaml").read_text())["method"] == TRUE_3DGS
    again = run(bench, *arguments)
    assert "2 kept" in again.stderr
    changed = run(bench, *arguments[:-1], "truth.dilation=2")
    assert "options.mask.dilation was 1, is 2" in str(changed.exception)
    shown = run(table, tmp_path / "runs")
    assert TRUE_3DGS in shown.stdout
    assert "refinesplat@mask=truth" in shown.stdout
