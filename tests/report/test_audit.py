"""`aw audit`: silent on tables in which everything is right, and finds what is planted."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.table import audit_command
from ambiguous_wild.core import AwError
from ambiguous_wild.report.audit import audit
from ambiguous_wild.report.audit_numbers import AuditFinding, read_tables
from tests.report.clean_tables import COLUMNS, Row, clean_tables, write

ROOT = Path(__file__).resolve().parents[2]
REPORTED = ROOT / "ambiguous_wild/report/reported"


def findings(rows: list[Row], folder: Path) -> list[AuditFinding]:
    return audit(read_tables([write(rows, folder / "tables.csv")]))


def pick(rows: list[Row], **want: str) -> list[Row]:
    return [r for r in rows if all(r[k] == v for k, v in want.items())]


def test_clean_tables_have_no_findings(tmp_path: Path) -> None:
    found = {seed: findings(clean_tables(seed), tmp_path) for seed in range(12)}
    assert {seed: [f.text for f in fs] for seed, fs in found.items() if fs} == {}


def test_our_own_board_has_no_findings() -> None:
    assert [f.text for f in audit(read_tables([ROOT / "leaderboard/measured/all.csv"]))] == []


def entry(rows: list[Row], method: str = "method 1", scene: str = "scene 00") -> dict[str, Row]:
    chosen = pick(rows, table="set 0", method=method, scene=scene)
    return {r["metric"]: r for r in chosen}


def copy(source: dict[str, Row], target: dict[str, Row]) -> None:
    for key, row in target.items():
        row["value"] = source[key]["value"]


def shift(row: Row, by: float, digits: int = 2) -> None:
    row["value"] = f"{float(row['value']) + by:.{digits}f}"


def copied_memory(rows: list[Row]) -> None:
    first, second = (pick(rows, table="memory", scene=scene) for scene in ("scene 00", "scene 01"))
    copy({r["method"]: r for r in first}, {r["method"]: r for r in second[:4]})


def exchanged_methods(rows: list[Row]) -> None:
    for a, b in ((1, 2), (2, 1)):
        source = pick(rows, table="memory", scene="scene 00", method=f"method {a}")[0]
        rows.append({**source, "table": "memory again", "method": f"method {b}"})


def exchanged_cell(rows: list[Row]) -> None:
    """On the scene where it shows most: where SSIM and LPIPS are alike nobody could tell."""
    scenes = sorted({r["scene"] for r in pick(rows, table="set 0")})
    swap(max((entry(rows, scene=s) for s in scenes), key=gap))


def exchanged_columns(rows: list[Row]) -> None:
    main = pick(rows, table="set 0")
    methods, scenes = (sorted({r[k] for r in main}) for k in ("method", "scene"))
    scene = max(scenes, key=lambda s: min(gap(entry(rows, m, s)) for m in methods))
    for method in methods:
        swap(entry(rows, method, scene))


def gap(e: dict[str, Row]) -> float:
    return float(e["ssim"]["value"]) - float(e["lpips"]["value"])


def swap(e: dict[str, Row]) -> None:
    e["ssim"]["value"], e["lpips"]["value"] = e["lpips"]["value"], e["ssim"]["value"]


def wrong_mean(rows: list[Row]) -> None:
    shift(pick(rows, table="means", method="method 1", dataset="set 0", metric="psnr")[0], -0.1)


def slipped_point(rows: list[Row]) -> None:
    shift(entry(rows)["ssim"], -0.9 * float(entry(rows)["ssim"]["value"]), 3)


def wrong_rank(rows: list[Row]) -> None:
    for r in pick(rows, table="set 0", scene="scene 00", metric="psnr"):
        r["mark"] = {"1": "3", "3": "1"}.get(r["mark"], r["mark"])


PLANTS: dict[str, tuple[str, Callable[[list[Row]], object]]] = {
    "copied row": ("repeated", lambda rows: copy(entry(rows), entry(rows, scene="scene 01"))),
    "copied method": ("repeated", lambda rows: copy(entry(rows), entry(rows, "method 2"))),
    "copied memory": ("repeated", copied_memory),
    "other value": ("contradiction", lambda rows: shift(pick(rows, table="ablation", setting="")[0], 0.4)),
    "exchanged methods": ("swapped", exchanged_methods),
    "exchanged cell": ("swapped", exchanged_cell),
    "exchanged columns": ("swapped", exchanged_columns),
    "wrong mean": ("mean", wrong_mean),
    "impossible": ("out of place", lambda rows: shift(entry(rows)["ssim"], 1.0, 3)),
    "slipped point": ("out of place", slipped_point),
    "wrong rank": ("rank", wrong_rank),
    "lost digit": ("digits", lambda rows: shift(entry(rows)["psnr"], 0.001, 3)),
    "no unit": ("unit", lambda rows: pick(rows, metric="memory")[0].update(variant="")),
}  # fmt: skip


@pytest.mark.parametrize("kind,plant", PLANTS.values(), ids=PLANTS)
def test_what_is_planted_is_found(kind: str, plant: Callable[[list[Row]], object], tmp_path: Path) -> None:
    missed, tried = [], 0
    for seed in range(5):
        rows = clean_tables(seed)
        scenes = {r["scene"] for r in pick(rows, table="set 0")}
        # An exchange is told from a weak result by what other scenes have.
        if len(scenes) < 4 or len({r["method"] for r in rows}) < 6:
            continue
        tried += 1
        plant(rows)
        found = findings(rows, tmp_path)
        if not any(f.kind == kind for f in found):
            missed.append((seed, [f.text for f in found]))
    assert tried and missed == []


def reported() -> list[AuditFinding]:
    return audit(read_tables([REPORTED]))


SAID = [  # parts of findings in the paper's tables
    ("repeated", "Mip-Splatting on Porter", "Lounge", "19.12 / 0.661 / 0.194"),
    ("repeated", "3DGS on Turtle", "Straw"),
    *(("repeated", here, there, "memory", "3DGS", "Mip-Splatting", "DroneSplat", "RobustSplat")
      for here, there in (("Porter", "Mountain"), ("Humanoid", "Fountain"), ("Jockey", "Corner"),
                          ("Lounge", "Patio "), ("Monster", "Spot"), ("Artwork", "Patio-High"))),
    ("swapped", "DroneSplat and RobustSplat on Humanoid", "110.01 and 51.32"),
    ("contradiction", "RefineSplat on Humanoid", "22.11 against 19.71"),
    ("contradiction", "RobustSplat on Humanoid", "20.19 against 19.10"),
    ("mean", "RefineSplat", "On-the-go", "23.44", "23.53"),
    ("contradiction", "occlusion_max_percent 60 against 45"),
    ("repeated", "Splatfacto-W on Patio and Splatfacto-W on Patio-High"),
    ("repeated", "GS-W on Patio and GS-W on Patio-High"),
    ("swapped", "RobustSplat on Trevi-Fountain", "0.213", "0.727"),
    ("unit", "memory"),
    # and what nobody had listed
    ("repeated", "Bookstore", "Bust"),
    ("repeated", "RobustSplat on the mean of NeRF On-the-go and WildGaussians on the mean"),
    ("rank", "psnr on Lounge", "AsymGS 21.53"),
]  # fmt: skip


def test_in_the_paper_it_finds_what_people_found() -> None:
    lines = [f"{f.kind} | {f.text}" for f in reported()]
    assert [words for words in SAID if not any(all(w in line for w in words) for line in lines)] == []


def test_a_method_weak_everywhere_is_not_called_exchanged() -> None:
    swapped = [f for f in reported() if f.kind == "swapped"]
    assert swapped and not [f for f in swapped if "Ha-NeRF" in f.text]


def test_the_transcription_is_what_was_printed() -> None:
    rows = [r for p in sorted(REPORTED.glob("*.csv")) for r in csv.DictReader(p.open(encoding="utf-8"))]
    assert set(rows[0]) == set(COLUMNS) and len({r["table"] for r in rows}) == 25
    assert all(r["printed"] == r["value"] for r in rows if r["value"] and not r["table"].startswith("text"))
    assert {r["printed"] for r in rows if not r["value"]} == {"-", "< 1"}

    def value(table: str, method: str, scene: str, metric: str, setting: str = "") -> list[str]:
        want = {"table": table, "method": method, "scene": scene, "metric": metric, "setting": setting}
        return [r["value"] for r in pick(rows, **want)]

    assert value("tab:ambi_quanti", "AsymGS", "Statuette", "lpips") == ["0.237"]
    assert value("sub_tab:ambi_quan_2", "RobustSplat", "Straw", "psnr") == ["23.195"]
    assert value("tab:memory_size", "DroneSplat", "Sacre Coeur", "memory") == ["77.12"]
    assert value("tab:entropy-aware_plug", "WildGaussians", "Humanoid", "ssim", "M_final, T_ent") == ["0.861"]
    assert value("tab:impact_of_module", "RefineSplat", "mean", "psnr", "EAM + CR") == ["23.46", "23.13"]
    assert value("tab:density_control", "RobustSplat", "Jewel", "memory") == ["231.51"]


def run(*words: object) -> str:
    done = CliRunner().invoke(audit_command, [str(w) for w in words], catch_exceptions=False)
    assert done.exit_code == 0
    return done.stdout


def error(*words: object) -> str:
    raised = CliRunner().invoke(audit_command, [str(w) for w in words]).exception
    assert isinstance(raised, AwError), raised
    return str(raised)


def test_the_command_writes_every_format_and_tells_by_its_exit_code(tmp_path: Path) -> None:
    rows = clean_tables(0)
    good, bad = write(rows, tmp_path / "good.csv"), tmp_path / "bad.csv"
    wrong_mean(rows)
    entry(rows)["ssim"]["method"] = entry(rows)["lpips"]["method"] = "=cmd|<b>"
    write([*rows, {**rows[0], "table": "again", "method": "=cmd|<b>", "value": "300.00"}], bad)
    facts = json.loads(run(bad, "--json"))
    assert facts and set(facts[0]) == {"kind", "text", "tables", "where"}
    assert facts[0]["where"][0].startswith("bad.csv:")
    for name in ("out.csv", "out.md", "out.txt"):
        run(bad, "-o", tmp_path / name)
    table = list(csv.reader((tmp_path / "out.csv").read_text().splitlines()))
    assert len(table) == len(facts) + 1 and not [c for line in table for c in line if c[:1] == "="]
    assert "<b>" not in (tmp_path / "out.md").read_text()
    assert "mean: " in (tmp_path / "out.txt").read_text()
    assert CliRunner().invoke(audit_command, [str(bad), "--strict"]).exit_code == 1
    assert CliRunner().invoke(audit_command, [str(good), "--strict"]).exit_code == 0
    assert run(good) == "" and "memory" in run()  # without files: those of the checkout


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "lacks the column"),
        (b"method,scene,metric\na,b,c\n", "lacks the column value"),
        (b"method,scene,metric,value\n", "no number in"),
        (b"method,scene,metric,value\na,b,psnr,much\n", "line 2: 'much' is no number"),
        (b"method,scene,metric,value\na,b,psnr,nan\n", "'nan' is no number"),
        (b"method,scene,metric,value\na,b,psnr,1e999\n", "is no number"),
        (b"method,scene,metric,value\na,b\n", "too few or too many"),
        (b"method,scene,metric,value\n,b,psnr,3\n", "no method"),
        (b"method,scene,metric,value,mark\na,b,psnr,3,9\n", "none of 1, 2, 3"),
        (b"\xff\xfe\x00\x01", "no text in UTF-8"),
    ],
)
def test_a_table_that_is_none_is_refused_in_one_line(content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes(content)
    message = error(tmp_path / "t.csv")
    assert words in message and "t.csv" in message and "\n" not in message
    assert "cannot read" in error(tmp_path / "absent.csv")
    (tmp_path / "empty").mkdir()
    assert "no *.csv" in error(tmp_path / "empty")


def test_chance_is_measured_not_assumed(tmp_path: Path) -> None:
    # Two digits, one scene's numbers all alike: equal triples are what chance gives, and not a finding.
    rng = np.random.default_rng(0)
    rows = []
    for scene in range(12):
        for method in range(8):
            for metric, value in (("psnr", 20 + rng.integers(4) / 10), ("ssim", 0.7 + rng.integers(3) / 100),
                                  ("lpips", 0.2 + rng.integers(3) / 100)):  # fmt: skip
                digits = 1 if metric == "psnr" else 2
                what = {"table": "t", "method": f"m{method}", "dataset": "d", "scene": f"s{scene}"}
                rows.append({**what, "metric": metric, "variant": "stated", "value": f"{value:.{digits}f}"})
    assert [f for f in findings(rows, tmp_path) if f.kind == "repeated"] == []
