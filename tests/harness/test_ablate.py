"""Ablations: variants are ordinary cells, equal settings share runs, what is not there says so."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import with_options
from ambiguous_wild.harness.ablation_study import plan_study, read_outcomes, report
from ambiguous_wild.harness.cell import reproduce_command
from ambiguous_wild.harness.grid import cell_folder, run_cells
from ambiguous_wild.harness.result_file import write_result
from ambiguous_wild.harness.store import read_runs
from ambiguous_wild.methods import MethodEntry, get_method, register
from ambiguous_wild.methods.ablation_groups import Group, Variant, check_groups, choose_groups
from ambiguous_wild.report import ablation_report
from ambiguous_wild.report.ablation_report import markdown_of, write_report
from ambiguous_wild.splat.density import DensityConfig
from ambiguous_wild.splat.method_hooks import MethodHooks
from ambiguous_wild.splat.train_config import TrainConfig
from tests.command_line import aw
from tests.harness.fake_runs import fake_result

SHORT = TrainConfig(iterations=30, probes=0)
GROUPS = (
    Group(
        "size", "how large", (Variant("small", ("grow_grad=0.1",)), Variant("same", ("grow_grad=0.0002",)))
    ),
    Group(
        "other",
        "the rest",
        (
            Variant("small-too", ("grow_grad=0.1",)),
            Variant("to-come", ("not_there=1",)),
            Variant("peer", method="no-such-method"),
            Variant("plain", method="3dgs"),
        ),
    ),
)


@pytest.fixture(autouse=True)
def _methods():
    register(
        MethodEntry(
            "mine",
            "3dgs whose density can be set",
            lambda options: MethodHooks(density_config=options),
            config=DensityConfig,
            ablations=GROUPS,
        )
    )


def study(scene, **kw):
    return plan_study("mine", [scene], kw.pop("seeds", [0]), SHORT, **kw)


def names(plan):
    return [cell.method.name for cell in plan.cells]


def test_equal_settings_share_one_run_and_what_is_not_there_is_a_row(scene):
    plan = study(scene)
    assert names(plan) == ["mine", "mine@size-small", "3dgs"]
    rows = {(row.group, row.variant.name): row for row in plan.rows}
    assert rows["size", "same"].same_as == "default"
    assert rows["other", "small-too"].same_as == "size-small"
    assert "unknown option 'not_there'" in rows["other", "to-come"].missing
    assert "unknown method 'no-such-method'" in rows["other", "peer"].missing
    assert [row.variant.name for row in plan.rows if row.variant.name == "default"] == ["default", "default"]


def test_a_run_keeps_its_folder_whatever_groups_are_chosen(scene):
    assert names(study(scene, groups=["other"])) == ["mine", "mine@size-small", "3dgs"]


def test_settings_hold_in_every_row_and_become_the_default(scene):
    plan = study(scene, settings=["grow_grad=0.1"])
    assert {cell.options.grow_grad for cell in plan.default} == {0.1}
    rows = {row.variant.name: row for row in plan.rows}
    assert rows["small"].same_as == "default"
    assert rows["same"].cells[0].options.grow_grad == 0.0002


def test_every_scene_and_seed_has_its_own_folder(scene, tmp_path):
    cells = study(scene, seeds=[0, 1]).cells
    assert len({cell_folder(tmp_path, cell) for cell in cells}) == len(cells) == 6
    assert len({cell.identity for cell in cells}) == 6


def test_without_a_length_every_row_has_the_default_of_the_scene(scene):
    for given, iterations in ({}, SHORT.iterations), ({"default_length": True}, 7000):
        assert {cell.train.iterations for cell in study(scene, **given).cells} == {iterations}


def test_runs_of_a_study_are_those_of_aw_table_and_are_kept(scene, tmp_path):
    plan = study(scene)
    assert {r.outcome for r in run_cells(plan.cells, tmp_path)} == {"trained"}
    assert {r.outcome for r in run_cells(plan.cells, tmp_path)} == {"kept"}
    assert set(read_runs(tmp_path).runs["method"]) == set(names(plan))
    written = write_report(report(plan, tmp_path), tmp_path)
    assert {p.name for p in written} == {f"ablation.{kind}" for kind in ("json", "csv", "md", "png")}


def save(cells, output, **values):
    """Made-up results: PSNR by (method, scene, seed)."""
    for cell in cells:
        result = fake_result(cell.method.name, cell.scene.name, cell.train.seed, (values["psnr"](cell),))
        result["config_hash"] = values.get("config_hash", cell.identity)
        result["masks"] = {"iou": values["iou"](cell), "precision": 0.5, "recall": 0.25}
        result["cost"] |= {"setup_s": 2.0, "ms_per_iteration": values["ms"](cell)}
        if cell.method.name == values.get("contended"):
            result["cost"]["timing"] |= {"verdict": "contended", "reason": "2 runs at once"}
        write_result(cell_folder(output, cell) / "metrics.json", result)


def test_means_spreads_and_paired_differences(scene, tmp_path):
    plan = study(scene, seeds=[0, 1, 2])
    gain = {"mine": (0, 0, 0), "mine@size-small": (1.0, 3.0, 2.0), "3dgs": (-1.0, -1.0, -1.0)}
    base = (20.0, 30.0, 25.0)
    save(
        plan.cells,
        tmp_path,
        psnr=lambda c: base[c.train.seed] + gain[c.method.name][c.train.seed],
        iou=lambda c: 0.5 + 0.1 * (c.method.name == "mine@size-small"),
        ms=lambda c: 10.0 * (1 + (c.method.name == "3dgs")),
        contended="3dgs",
    )
    data = report(plan, tmp_path)
    rows = {(r["group"], r["variant"]): r for r in data["rows"]}
    small = rows["size", "small"]
    assert small["values"]["psnr"]["mean"] == pytest.approx(27.0)
    assert small["values"]["psnr"]["spread"] == pytest.approx(np.std([21, 33, 27], ddof=1))
    # paired: the spread between seeds of the scene itself cancels
    assert small["differences"]["psnr"] == {"mean": pytest.approx(2.0), "spread": pytest.approx(1.0)}
    assert small["differences"]["iou"]["mean"] == pytest.approx(0.1)
    assert small["values"]["total_s"]["mean"] == pytest.approx(10 + 1 + 2)  # train_s is 10 + seed
    other = rows["other", "plain"]["differences"]  # it was not alone: no difference of times
    assert other["ms_per_iteration"]["mean"] is None and other["psnr"]["mean"] < 0
    assert small["differences"]["ms_per_iteration"]["mean"] == 0.0
    assert rows["size", "same"]["differences"]["psnr"]["mean"] == 0.0
    assert rows["size", "default"]["values"]["recall"]["mean"] == 0.25
    text = markdown_of(data)  # the slower run was not alone: nothing is left to rank
    assert "times not ranked: plain (contended: 2 runs at once)" in text and "**10.0** (1)" not in text


def test_what_is_missing_or_failed_is_told_never_dropped(scene, tmp_path):
    plan = study(scene, seeds=[0, 1])
    done = [c for c in plan.cells if (c.method.name, c.train.seed) != ("mine@size-small", 1)]
    save(done, tmp_path, psnr=lambda c: 20.0, iou=lambda c: 0.5, ms=lambda c: 1.0)
    data = report(plan, tmp_path)
    rows = {(r["group"], r["variant"]): r for r in data["rows"]}
    assert len(data["rows"]) == sum(len(g.variants) + 1 for g in GROUPS)
    assert rows["size", "small"]["status"] == "failed"
    assert rows["size", "small"]["values"]["psnr"]["mean"] is None  # one of two seeds is no mean
    assert rows["other", "to-come"]["status"] == "missing"
    text = markdown_of(data)
    assert "- small failed: scene, seed 1: not run" in text
    assert "- peer missing: unknown method" in text
    write_report(data, tmp_path)
    table = list(csv.DictReader((tmp_path / "ablation.csv").open()))
    assert [row["variant"] for row in table] == [r["variant"] for r in data["rows"]]
    assert json.loads((tmp_path / "ablation.json").read_text())["rows"] == data["rows"]


def test_runs_of_another_configuration_are_left_as_they_are(scene, tmp_path):
    plan = study(scene)
    numbers = {"psnr": lambda c: 20.0, "iou": lambda c: 0.5, "ms": lambda c: 1.0}
    save(plan.cells, tmp_path, config_hash="of 40 iterations", **numbers)
    outcomes = read_outcomes(plan.cells, tmp_path)
    assert {outcome.error for outcome in outcomes} == {"a run of another configuration, left as it is"}


def test_a_failed_run_brings_its_error(scene, tmp_path):
    plan = study(scene)
    cell = plan.cells[1]
    result = fake_result(cell.method.name, "scene", 0, (), status="failed", error="no weights here", cost={})
    result["config_hash"] = cell.identity
    write_result(cell_folder(tmp_path, cell) / "failed.json", result)
    (outcome,) = read_outcomes([cell], tmp_path)
    assert outcome.error == "no weights here" and outcome.value("psnr") is None


def test_names_that_cannot_be_folders_are_refused():
    for bad in ("a/b", "..", "Big", "", "default"):
        with pytest.raises(AwError, match="cannot be called"):
            check_groups("m", [Group("g", "t", (Variant(bad),))])
    with pytest.raises(AwError, match="twice"):
        check_groups("m", [replace(GROUPS[0], name="g"), replace(GROUPS[1], name="g")])


@pytest.mark.parametrize("name", ["refinesplat", "refinesplat-paper"])
def test_refinesplats_ablations_name_options_it_has(name):
    entry = get_method(name)
    groups = choose_groups(name, entry.ablation_groups(), [])
    assert [g.name for g in groups][:3] == ["modules", "masks", "thresholds"]
    for variant in (v for g in groups for v in g.variants):
        pairs = dict(setting.split("=") for setting in variant.settings)
        if variant.method and pairs:
            assert f"={name}" in variant.method, f"{variant.name} sets options of a method that is not in it"
        assert len(pairs) == len(variant.settings), f"{variant.name} sets an option twice"
        options = with_options(entry.options(), pairs)
        for key, text in pairs.items():
            value = _at(options, key)
            shown = (
                {None: "none", True: "true", False: "false"}[value] if value in (None, True, False) else value
            )
            # 0.10 and 0.1 are one number
            assert shown == text or value == float(text), key


def test_the_printed_threshold_is_ablated_without_what_would_hide_it():
    groups = {g.name: g for g in get_method("refinesplat").ablation_groups()}
    for group in ("thresholds", "printed"):
        (variant,) = [v for v in groups[group].variants if v.name == "t-ent-literal"]
        options = with_options(
            get_method("refinesplat").options(), dict(s.split("=") for s in variant.settings)
        )
        mask = options.mask
        assert (mask.threshold, mask.gate, mask.floor, mask.ceiling) == ("literal", 0.0, 0.0, 0.0)


def test_a_graft_of_the_method_is_a_row_with_settings(scene):
    """The method's masks or density in another method: the study's settings and the variant's reach them."""
    rows = (
        Variant("plain", method="3dgs"),
        Variant("with", ("grow_grad=0.1",), method="3dgs@density=mine"),
        Variant("without", method="3dgs@density=mine"),
    )
    register(replace(get_method("mine"), ablations=(Group("plug-in", "in others", rows),)))
    plan = plan_study("mine", [scene], [0], SHORT, settings=["grow_scale=0.5"])
    names = {row.variant.name: row.cells[0] for row in plan.rows if row.variant.name != "default"}
    assert names["plain"].method.name == "3dgs"
    for name, grow in (("with", 0.1), ("without", 0.0002)):
        cell = names[name]
        assert cell.method.name == f"mine@plug-in-{name}"
        assert (cell.options.density.grow_scale, cell.options.density.grow_grad) == (0.5, grow)
    command = reproduce_command(names["with"])
    assert "--method 3dgs@density=mine" in command
    assert "--set mine.grow_grad=0.1" in command and "--set mine.grow_scale=0.5" in command
    # without settings it is an ordinary graft, whose runs others share
    plain = plan_study("mine", [scene], [0], SHORT)
    assert {row.cells[0].method.name for row in plain.rows if row.variant.name == "without"} == {
        "3dgs@density=mine"
    }


def _at(options, key):
    for part in key.split("."):
        options = getattr(options, part)
    return options


def test_values_of_an_option_of_a_method_in_a_file_are_swept_without_a_registry_entry(
    scene, tmp_path, monkeypatch
):
    own = tmp_path / "my.py"
    own.write_text(
        "from dataclasses import dataclass\nfrom ambiguous_wild.splat.method_hooks import MethodHooks\n"
        "@dataclass(frozen=True)\nclass Config:\n    sh_degree: int = 2\n"
        "def mine(config: Config): return MethodHooks(sh_degree=config.sh_degree)\n"
    )
    words = ["ablate", "--method", f"{own}:mine", "--scene", scene, "--iterations", "3", "--device", "cpu"]
    done = aw(*words, "--sweep", "sh_degree=0,2,1", "-o", tmp_path / "ablation")
    assert done.returncode == 0, done.stderr
    rows = list(csv.DictReader((tmp_path / "ablation/ablation.csv").open()))
    assert [row["variant"] for row in rows] == ["default", "0", "2", "1"] and rows[0]["group"] == "sh_degree"
    assert all(row["psnr"] for row in rows)
    # the default says its value, and the values are the axis of the plot
    assert [row["settings"] for row in rows] == [f"sh_degree={value}" for value in (2, 0, 2, 1)]
    data = json.loads((tmp_path / "ablation/ablation.json").read_text())
    panels = []
    monkeypatch.setattr(ablation_report, "label_points", lambda axes, ends: panels.append((axes, ends)))
    assert ablation_report.draw(data, tmp_path / "again.png")
    ((axes, ends),) = panels
    assert axes.get_xlabel() == "sh_degree" and [end[0] for end in ends] == ["default (2)"]
    assert list(axes.lines[0].get_xdata()) == [0.0, 1.0, 2.0]
    assert "unknown option of --sweep 'sh_degre'" in aw(*words, "--sweep", "sh_degre=1").stderr
