"""Plug and play: places of one method filled by another, by name, by option and in the table."""

import json
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner

from ambiguous_wild.cli.bench import command as bench
from ambiguous_wild.cli.table import table_command as table
from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import with_options
from ambiguous_wild.harness.grid import plan_cells
from ambiguous_wild.methods import MethodEntry, get_method, register
from ambiguous_wild.methods.graft import check_graft, combine_policies, graft_name
from ambiguous_wild.methods.mask_policies import GraftedMaskPolicy
from ambiguous_wild.methods.refinesplat.density_control import EntropyAwareDensity
from ambiguous_wild.methods.refinesplat.recipe import RefineSplatMask
from ambiguous_wild.methods.robustsplat import RobustSplatConfig, RobustSplatMask
from ambiguous_wild.methods.truth import TruthMask
from ambiguous_wild.splat.density import DensityControl
from ambiguous_wild.splat.effects import with_effects
from ambiguous_wild.splat.effects.colour import AffineExposure
from ambiguous_wild.splat.method_hooks import MaskPolicy, MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig
from tests.methods.baselines import parts_of, trained
from tests.splat.scenes import bits

TRUE_3DGS = "3dgs@mask=truth"


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
    assert isinstance(parts.mask, GraftedMaskPolicy)
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


def test_a_donors_plugin_is_part_of_the_identity():
    hashes = []
    for source in ("a", "b"):
        register(MethodEntry("mine", "", "ambiguous_wild.methods.threedgs:build", source_hash=source))
        hashes.append(get_method("refinesplat@mask=mine").source_hash)
    assert len({*hashes, ""}) == 3
    assert get_method("refinesplat@mask=3dgs").source_hash == ""


# -- effects ------------------------------------------------------------------------------------------


@pytest.fixture
def toned():
    """A method whose recipe brings an effect of its own, an affine exposure per photo."""

    class Toned(RobustSplatMask):
        def cotangent(self, step, keep):
            return None

    def build(options):
        return MethodHooks(mask=Toned(RobustSplatConfig()), effects=(AffineExposure(),))

    return register(MethodEntry("toned", "", build))


def warnings_of(name, **options):
    entry = get_method(name)
    return check_graft(entry, with_options(entry.options(), options))


@pytest.mark.parametrize("place", ["mask", "regulariser"])
def test_a_donors_effects_that_are_left_out_are_named(toned, place, recwarn):
    line = "leaves out toned's effects (exposure): add effects=toned to the name to take them, or effects="
    (found,) = warnings_of(f"3dgs@{place}=toned")
    assert found == f"{line}none to leave them out without this warning"
    # where `effects=none` would take the host's own effects away, its name keeps them
    (found,) = warnings_of(f"swag@{place}=toned")
    assert found == f"{line}swag to leave them out without this warning"
    assert parts_of(f"3dgs@{place}=toned").effects == () and not recwarn.list
    assert warnings_of("swag@effects=swag,mask=toned") == []
    assert len(warnings_of("3dgs@mask=toned,regulariser=toned")) == 1


@pytest.mark.parametrize("name", ["3dgs@density=toned", "3dgs@density=gs-w", "toned@mask=none"])
def test_effects_that_do_not_matter_are_not_named(toned, name, recwarn):
    assert warnings_of(name) == []
    assert parts_of(name).density is not None and not recwarn.list


def test_the_effects_of_a_donor_are_taken_where_they_are_asked_for(toned, recwarn):
    parts = parts_of("3dgs@effects=toned, mask=toned")
    assert [effect.name for effect in parts.effects] == ["exposure"]
    assert parts_of("3dgs@mask=toned,effects=none").effects == ()
    assert len(parts_of("toned@mask=3dgs").effects) == 1  # a host's own stay
    assert parts_of("toned@effects=none").effects == ()
    assert len(parts_of("toned@mask=toned").effects) == 1
    assert not recwarn.list


def test_effects_that_are_taken_change_what_they_need_of_the_renderer():
    register(MethodEntry("filtered", "", lambda options: with_effects(MethodHooks(), ["antialias"])))
    assert not parts_of("3dgs").antialias
    parts = parts_of("3dgs@effects=filtered")
    assert parts.antialias and [effect.name for effect in parts.effects] == ["antialias"]


def test_a_graft_trains_with_the_effects_it_takes(toned, scene, tmp_path):
    trainer = trained(scene, tmp_path / "run", parts_of("3dgs@effects=toned"), 8)
    assert "exposure" in trainer.effects.facts()
    assert bits(trainer) != bits(trained(scene, tmp_path / "plain", MethodHooks(), 8))


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
    second = MethodHooks(
        **{**vars(parts), "mask": GraftedMaskPolicy(RobustSplatMask(parts.mask.config), None)}
    )
    assert bits(trained(scene, tmp_path / "second", second, 60)) == bits(own)


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
    (line,) = check_graft(off.method, off.options)
    assert "refinesplat adds no loss" in line and "--set refinesplat.KEY=VALUE" in line
    assert check_graft(on.method, on.options) == []
    assert check_graft(none.method, none.options) == []
    assert check_graft(get_method("3dgs"), None) == []


OF_ITS_FIELDS = "would mask nothing: the masks of {} come from its own fields.*use {} as the host"
NO_LOSS = "{0} would add nothing: {0} has no loss of this kind"
REFUSED = {
    "3dgs@mask=desplat": OF_ITS_FIELDS.format("desplat", "desplat"),
    "3dgs@mask=desplat+2passes": OF_ITS_FIELDS.format("desplat", "desplat"),
    "gs-w@mask=forestsplats": OF_ITS_FIELDS.format("forestsplats", "forestsplats"),
    "3dgs@mask=forestsplats,effects=forestsplats": OF_ITS_FIELDS.format("forestsplats", "forestsplats"),
    "3dgs@effects=forestsplats": "effects=forestsplats would change no picture",
    "forestsplats@effects=none": "fields of forestsplats need its effects.*leave effects=none out",
    "3dgs@mask=gs-w": "masks of gs-w need its effects: add effects=gs-w to the name$",
    "3dgs@mask=gs-w,effects=wildgaussians": "write effects=gs-w instead of effects=wildgaussians$",
    "gs-w@effects=wildgaussians": "masks of gs-w need its own effects, which effects=wildgaussians replaces: "
    "add mask=wildgaussians or mask=none to the name",
    "gs-w@effects=none": "replaces: add mask=none to the name, or leave effects=none out$",
    "splatfacto-w@effects=wildgaussians": "add mask=wildgaussians,regulariser=none or mask=none,",
    "3dgs@regulariser=splatfacto-w": "losses of splatfacto-w need its effects: add effects=splatfacto-w",
    "3dgs@regulariser=asymgs": "losses of asymgs need its effects: add effects=asymgs",
    "gs-w@regulariser=mcmc": NO_LOSS.format("mcmc"),
    "3dgs@regulariser=swag": NO_LOSS.format("swag"),
    "3dgs@regulariser=gs-w": NO_LOSS.format("gs-w"),  # its loss trains its masks
    "3dgs@regulariser=asymgs-twin": NO_LOSS.format("asymgs-twin"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_graft_that_would_do_nothing_or_cannot_train_is_refused(name, recwarn):
    for check in (warnings_of, parts_of):
        with pytest.raises(AwError, match=REFUSED[name]) as refused:
            check(name)
        assert "\n" not in str(refused.value)
    assert not recwarn.list


@pytest.mark.parametrize(
    "name",
    [
        "desplat@mask=desplat",
        "desplat@mask=truth",
        "forestsplats@mask=truth",
        "desplat+2passes",
        "gs-w@mask=none,effects=none",
        "gs-w@mask=gs-w,effects=gs-w",
        "3dgs@regulariser=none",
        "splatfacto-w@mask=none,regulariser=none,effects=none",
    ],
)
def test_what_the_advice_names_is_accepted(name):
    assert warnings_of(name) == []
    assert parts_of(name.removesuffix("+2passes")).mask is not None


def test_a_graft_is_refused_before_anything_is_trained_or_made(scene, tmp_path):
    arguments = ["--method", "3dgs", "--scene", scene, "--iterations", "5", "-o", tmp_path / "runs"]
    for more in (
        ["--method", "3dgs@mask=desplat"],
        ["--mask", "desplat", "--method", "3dgs+2passes"],
        ["--method", "3dgs@mask=gs-w"],
        ["--method", "3dgs@regulariser=mcmc"],
    ):
        result = run(bench, *arguments, *more)
        assert isinstance(result.exception, AwError), result.output
        assert str(result.exception).startswith("3dgs@") and "leaves out" not in result.output
        assert not (tmp_path / "runs").exists()


def test_effects_that_are_left_out_are_one_line_of_warning(scene, tmp_path, recwarn):
    arguments = ["--method", "3dgs@mask=wildgaussians", "--scene", scene, "--iterations", "5"]
    result = run(bench, *arguments, "-o", tmp_path / "runs", "--no-pictures")
    assert result.exit_code == 0, result.output
    assert result.stderr.count("leaves out") == 1
    assert "warning: 3dgs@mask=wildgaussians: leaves out wildgaussians's effects" in result.stderr
    assert not [warning for warning in recwarn if "leaves out" in str(warning.message)]


PROGRAMS = {
    "external:opensplat@density=uad": "external:opensplat is trained by another program, which takes no "
    "parts of other methods: leave density=uad out",
    "external:opensplat@mask=truth+2passes": "takes no parts of other methods: leave mask=truth out",
    "nerfbaselines:x@mask=truth": "nerfbaselines:x is trained by another program",
    "gs-w@density=external:opensplat": "trained by another program, which has no parts for other",
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_other_programs_neither_take_nor_give_parts(name):
    with pytest.raises(AwError, match=PROGRAMS[name]):
        get_method(name)


def test_other_programs_are_known_by_their_names_too(tmp_path):
    get_method("external:opensplat")
    with pytest.raises(AwError, match="opensplat is trained by another program, which takes no parts"):
        get_method("opensplat@density=uad")
    with pytest.raises(AwError, match="density=opensplat: opensplat is trained by another program"):
        get_method("3dgs@density=opensplat")
    odd = tmp_path / "a@mask=b.yaml"  # a file may be called so
    odd.write_text("name: odd\ntrain: 'true'\nrenders: '{stem}.png'\n")
    assert get_method(f"external:{odd}").name == "odd"


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

    policy = combine_policies(Masks(), Regulariser())
    assert policy.cotangent(None, policy.keep(None)) == "cotangent"
    assert seen == ["kept"]
    assert policy.predict(None) == "kept"
    assert (
        combine_policies(Regulariser(), Masks()).cotangent(None, None) is None
    )  # Masks has no loss of its own


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
