"""`aw study score`: planted preferences come back, and no answer file is believed unseen."""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from ambiguous_wild.cli.study import command
from ambiguous_wild.core import AwError
from ambiguous_wild.study.answers import Key
from ambiguous_wild.study.scores import agreement, bradley_terry
from tests.study.studies import METHODS, panel, panel_key, write_key, write_panel

STRENGTHS = {"refinesplat": 0.9, "robustsplat": 0.1, "3dgs": -1.0}


def score(*words: object) -> dict:
    done = CliRunner().invoke(command, ["score", *map(str, words), "--json"], catch_exceptions=False)
    return json.loads(done.stdout)


def error(*words: object) -> str:
    raised = CliRunner().invoke(command, ["score", *map(str, words)]).exception
    assert isinstance(raised, AwError), raised
    assert "\n" not in str(raised)
    return str(raised)


@pytest.fixture
def study(tmp_path: Path) -> tuple[Path, Path, dict[str, dict[str, Any]]]:
    """Key file, folder of answers, and the answers of twelve raters."""
    key = panel_key()
    files = panel(key, STRENGTHS, 12, np.random.default_rng(3), ties=0.1)
    return write_key(key, tmp_path / "s.key.json"), write_panel(files, tmp_path / "answers"), files


def test_a_panel_s_preferences_come_back(study: tuple[Path, Path, Any], tmp_path: Path) -> None:
    key, answers, files = study
    found = score(answers, "--key", key, "-o", tmp_path / "out")
    pairs = found["preference"]
    assert [s["method"] for s in pairs["ranking"]] == ["refinesplat", "robustsplat", "3dgs"]
    assert [(s["rank_low"], s["rank_high"]) for s in pairs["ranking"]] == [(1, 1), (2, 2), (3, 3)]
    # Counted by hand from the files.
    questions = json.loads(key.read_text())["questions"]
    wins = ties = lost = 0
    for data in files.values():
        for a in data["answers"]:
            entry = questions[a["question"]]
            if "refinesplat" in (entry.get("x"), entry.get("y")):
                ties += a["answer"] == "tie"
                wins += entry.get(a["answer"]) == "refinesplat"
                lost += entry.get(a["answer"]) not in ("refinesplat", None)
    row = next(m for m in pairs["methods"] if m["method"] == "refinesplat")
    assert (row["n"], row["ties"]) == (wins + lost, ties) and row["share"] == pytest.approx(
        wins / (wins + lost)
    )
    # Wilson's formula, written out.
    n, p, z = wins + lost, wins / (wins + lost), 1.959963984540054
    centre, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    assert row["low"] == pytest.approx((centre - half) / (1 + z * z / n))
    assert row["high"] == pytest.approx((centre + half) / (1 + z * z / n))
    assert row["raters_low"] < row["share"] < row["raters_high"]
    assert 0 < pairs["agreement"]["alpha"] < 0.5
    assert found["ambiguity"]["scenes"][0]["mean"] == 4 and found["ambiguity"]["scenes"][0]["hard"] == 1
    assert found["ambiguity"]["agreement"]["alpha"] is None
    assert score(answers, "--key", key, "-o", tmp_path / "out") == found  # again, bit by bit
    rows = list(csv.DictReader((tmp_path / "out/scores.csv").open()))
    strength = {r["name"]: float(r["value"]) for r in rows if r["level"] == "strength"}
    assert strength == {s["method"]: s["strength"] for s in pairs["ranking"]}
    assert "refinesplat" in (tmp_path / "out/scores.md").read_text()


def test_intervals_cover_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(7)
    key = panel_key(views=4)
    index = {m: i for i, m in enumerate(METHODS)}
    truth = np.array([STRENGTHS[m] for m in METHODS])
    covered = total = 0
    for _ in range(60):
        wins = np.zeros((10, 3, 3))
        for r, data in enumerate(panel(key, STRENGTHS, 10, rng).values()):
            for a in data["answers"]:
                entry = key.questions[a["question"]]
                if entry["kind"] == "preference":
                    other = "y" if a["answer"] == "x" else "x"
                    wins[r, index[entry[a["answer"]]], index[entry[other]]] += 1
        for s in bradley_terry(list(METHODS), wins)[0]:
            total += 1
            covered += s["low"] <= truth[index[s["method"]]] <= s["high"]
    # 180 intervals of 95 %: 0.91 is two and a half deviations below; above 0.995 they would be too wide.
    assert 0.91 <= covered / total <= 0.995


def test_what_answers_cannot_rank_is_said() -> None:
    apart = np.zeros((2, 4, 4))
    apart[:, 0, 1] = apart[:, 1, 0] = apart[:, 2, 3] = apart[:, 3, 2] = 1
    ranked, note = bradley_terry(list("abcd"), apart)
    assert ranked == [] and "2 groups" in note
    sweep = np.zeros((3, 2, 2))
    sweep[:, 0, 1] = 5
    ranked, note = bradley_terry(["a", "b"], sweep)
    assert ranked[0]["method"] == "a" and np.isfinite(ranked[0]["strength"]) and "lower bound" in note
    ranked, note = bradley_terry(["a", "b"], sweep[:1])
    assert ranked[0]["low"] is None and "one rater" in note and ranked[0]["rank_high"] == 2


def test_alpha_is_krippendorff_s() -> None:
    # The example of his 2011 paper, section E: nominal 0.743, interval 0.849.
    table = {
        "a": "1 2 3 3 2 1 4 1 2 - - -", "b": "1 2 3 3 2 2 4 1 2 5 - 3",
        "c": "- 3 3 3 2 3 4 2 2 5 1 -", "d": "1 2 3 3 2 4 4 1 2 5 1 -",
    }  # fmt: skip
    rows = [(r, str(q), int(v)) for r, line in table.items() for q, v in enumerate(line.split()) if v != "-"]
    assert agreement(rows, ordered=False)["alpha"] == pytest.approx(0.743, abs=5e-4)
    assert agreement(rows, ordered=True)["alpha"] == pytest.approx(0.849, abs=5e-4)
    assert agreement(rows[:5], ordered=False)["note"] == "no question was answered by two raters"


def test_without_the_libraries_the_command_that_brings_them(
    study: tuple[Path, Path, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for missing, package in (("choix", "choix"), ("nltk.metrics.agreement", "NLTK")):
        with monkeypatch.context() as m:
            m.setitem(sys.modules, missing, None)
            message = error(study[1], "--key", study[0])
            assert f"needs {package}" in message and "[study]" in message


def test_answers_too_fast_to_have_looked_are_counted_and_left_out(tmp_path: Path) -> None:
    key = panel_key()
    files = panel(key, STRENGTHS, 4, np.random.default_rng(0))
    private = write_key(key, tmp_path / "key.json")

    def scored(name: str) -> dict:
        folder = write_panel(files, tmp_path / name)
        return score(folder, "--key", private, "-o", tmp_path / f"{name}-scores")

    kept = scored("kept")
    # A fifth rater clicks left at once, and shows every outline.
    clicks = [
        {"question": q, "answer": "x", "left": "x", "ms": 999} if e["kind"] == "preference"
        else {"question": q, "answer": "1", "ms": 699, "outline": True}
        for q, e in key.questions.items()
    ]  # fmt: skip
    files["fast"] = {**files["r0"], "rater": "fast", "answers": clicks}
    found = scored("all")
    assert found["preference"] == kept["preference"] and found["ambiguity"] == kept["ambiguity"]
    fast = next(r for r in found["raters"] if r["rater"] == "fast")
    assert fast["too_fast"] == fast["answers"] == len(key.questions) and fast["outlined"] == 2
    told = (tmp_path / "all-scores" / "scores.md").read_text()
    assert f"{len(clicks)} of {5 * len(clicks)} answers took less than 0.7 s (photos) or 1 s" in told
    # At the limit an answer counts.
    for a in clicks:
        a["ms"] = 1000
    found = scored("slow")
    assert next(r for r in found["raters"] if r["rater"] == "fast")["too_fast"] == 0
    assert found["preference"] != kept["preference"]
    assert [s["outlined"] for s in found["ambiguity"]["scenes"]] == [2]


def test_csv_and_json_answers_score_alike(study: tuple[Path, Path, Any], tmp_path: Path) -> None:
    key, answers, files = study
    tables = tmp_path / "tables"
    tables.mkdir()
    for name, data in files.items():
        with open(tables / f"{name}.csv", "w", newline="") as f:
            writer = csv.writer(f, quoting=csv.QUOTE_ALL)
            writer.writerow(["study", "rater", "name", "question", "answer", "left", "ms"])
            for a in data["answers"]:
                head = [data["study"], data["rater"], data["name"]]
                writer.writerow([*head, a["question"], a["answer"], a.get("left", ""), a["ms"]])
    first = score(answers, "--key", key, "-o", tmp_path / "a")
    second = score(tables, "--key", key, "-o", tmp_path / "b")
    assert first["preference"] == second["preference"] and first["ambiguity"] == second["ambiguity"]


BAD: dict[str, tuple[Any, str]] = {
    "empty": ("", "is empty"),
    "blank": (" \n", "is empty"),
    "cut": ('{"format": "aw-study-answers", "vers', "truncated"),
    "other": ({"format": "something"}, "no answer file"),
    "array": ([1, 2], "no answer file"),
    "version": ({"version": 9}, "version 9"),
    "study": ({"study": "fff"}, "answers study 'fff'"),
    "rater": ({"rater": ""}, "no valid rater"),
    "half a character": ({"name": "\ud800"}, "half a character"),
    "half a rater": ({"rater": "\udfff"}, "half a character"),
    "rater type": ({"rater": ["a"]}, "no valid rater"),
    "none": ({"answers": []}, "contains no answer"),
    "outline": ({"answers": [{"question": "k0", "answer": "3", "ms": 900, "outline": "x"}]}, "as outline"),
    "unasked": ({"answers": [{"question": "zz", "answer": "x", "ms": 1}]}, "not in the study: 'zz'"),
    "no question": ({"answers": [{"question": ["p0"], "answer": "x", "ms": 1}]}, "not in the study"),
    "no dict": ({"answers": ["x"]}, "is no answer"),
    "choice": ({"answers": [{"question": "p0", "answer": "z", "left": "x", "ms": 1}]}, "allowed: x, y, tie"),
    "left": ({"answers": [{"question": "p0", "answer": "x", "left": "q", "ms": 1}]}, "as the left image"),
    "time": ({"answers": [{"question": "k0", "answer": "3", "ms": "nan"}]}, "no valid time"),
    "time is no number": ({"answers": [{"question": "k0", "answer": "3", "ms": True}]}, "no valid time"),
    "twice": ({"answers": [{"question": "k0", "answer": "3", "ms": 1}] * 2}, "twice"),
    "deep": ("[" * 100_000, "malformed"),
    "bytes": (b"\xff\xfe\x00", "not UTF-8 text"),
    "csv": ("a,b\n1,2\n", "first line must be"),
    "csv row": ("study,rater,name,question,answer,left,ms\nabc123,r,n,k0,3\n", "too few or too many"),
    "csv raters": (
        "study,rater,name,question,answer,left,ms\nabc123,r,n,k0,3,,1\nabc123,s,n,k1,3,,1\n",
        "more than one rater",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_answer_file_is_refused_in_one_line(
    name: str, study: tuple[Path, Path, dict[str, Any]], tmp_path: Path
) -> None:
    content, words = BAD[name]
    whole = {**study[2]["r0"], "rater": "new"}
    path = tmp_path / "bad.json"
    if isinstance(content, dict):
        content = json.dumps({**whole, **content})
    elif isinstance(content, list):
        content = json.dumps(content)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    message = error(study[1], path, "--key", study[0], "-o", tmp_path / "out")
    assert words in message and "bad.json" in message and not (tmp_path / "out").exists()


def test_the_same_rater_twice_and_the_key_as_answers(study: tuple[Path, Path, Any], tmp_path: Path) -> None:
    key, answers, _ = study
    (tmp_path / "copy.json").write_text((answers / "r3.json").read_text())
    assert "both of rater 'r3'" in error(answers, tmp_path / "copy.json", "--key", key)
    again = json.loads((answers / "r3.json").read_text())
    (tmp_path / "blank.json").write_text(json.dumps({**again, "rater": again["rater"] + " "}))
    assert "both of rater 'r3'" in error(answers, tmp_path / "blank.json", "--key", key)
    assert "given twice" in error(answers, answers / "r3.json", "--key", key)
    assert "give it with --key" in error(key, "--key", key)
    assert "is no key" in error(answers, "--key", answers / "r3.json")
    assert "cannot read the key" in error(answers, "--key", tmp_path / "absent.json")
    (tmp_path / "empty").mkdir()
    assert "no answer file" in error(tmp_path / "empty", "--key", key)
    write_key(Key("s", "t", {"a": {}}), key)
    assert "damaged" in error(answers, "--key", key)
    write_key(Key("s", "\ud800", {"a": {"kind": "ambiguity", "scene": "s", "view": "v"}}), key)
    assert "half a character" in error(answers, "--key", key)


def test_names_of_people_and_methods_stay_text(tmp_path: Path) -> None:
    methods = ("=HYPERLINK(1)", "<img src=x onerror=alert(1)>")
    key = panel_key(methods)
    files = panel(key, dict.fromkeys(methods, 0.0), 3, np.random.default_rng(0))
    files["r0"]["name"] = "<script>alert(1)</script>|[a](http://b)\n# head"
    answers = write_panel(files, tmp_path / "answers")
    score(answers, "--key", write_key(key, tmp_path / "s.key.json"), "-o", tmp_path / "out")
    text = (tmp_path / "out/scores.md").read_text()
    assert "<script" not in text and "<img" not in text and "\n# head" not in text and "[a](" not in text
    rows = list(csv.reader((tmp_path / "out/scores.csv").open()))
    assert not [c for row in rows for c in row if c[:1] in ("=", "@")]


def test_a_folder_with_other_files_is_not_replaced(study: tuple[Path, Path, Any], tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/thesis.tex").write_text("x")
    assert "thesis.tex" in error(study[1], "--key", study[0], "-o", tmp_path / "mine")
    score(study[1], "--key", study[0], "-o", tmp_path / "out")
    (tmp_path / "out/scores.mine").mkdir()
    (tmp_path / "out/scores.mine/notes.txt").write_text("x")
    assert "notes.txt" in error(study[1], "--key", study[0], "-o", tmp_path / "out")
    assert (tmp_path / "out/scores.mine/notes.txt").read_text() == "x"


def test_what_a_folder_of_answers_holds_besides_is_named(
    study: tuple[Path, Path, Any], tmp_path: Path
) -> None:
    key, answers, files = study
    (answers / "answers-anna.json.txt").write_text("{}")
    (answers / "bob").mkdir()
    words = ["score", str(answers), "--key", str(key), "-o", str(tmp_path / "out")]
    done = CliRunner().invoke(command, words, catch_exceptions=False)
    assert f"{len(files)} raters" in done.stdout
    assert "ignored answers-anna.json.txt, bob" in done.stderr


def test_files_of_the_user_under_the_scores_names_stay(study: tuple[Path, Path, Any], tmp_path: Path) -> None:
    key, answers, _ = study
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "scores.csv").write_text("mine")
    assert "scores.csv exists" in error(answers, "--key", key, "-o", tmp_path / "out")
    assert (tmp_path / "out" / "scores.csv").read_text() == "mine"
