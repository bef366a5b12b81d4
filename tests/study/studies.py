"""Scenes, runs, keys and raters made on the spot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml

from ambiguous_wild.harness.cell import scene_identity
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.study.answers import KEY_FORMAT, Key
from tests.harness.fake_runs import fake_result, save
from tests.tiny_scene import TEST, write_tiny_scene

METHODS = ("3dgs", "refinesplat", "robustsplat")


def write_runs(root: Path, methods: tuple[str, ...] = METHODS, name: str = "yard") -> tuple[Path, Path]:
    """A tiny scene and finished runs on it whose renders are the photos, blurred ever more."""
    scene = write_tiny_scene(root / name)
    runs, state = root / "runs", scene_identity(load_scene(scene))
    save(runs, *(fake_result(m, name, scene_hash=state) for m in methods))
    for number, method in enumerate(methods):
        folder = next((runs / name).glob("".join(c if c.isalnum() else "_" for c in method))) / "seed0"
        (folder / "renders/test").mkdir(parents=True)
        config = {"method": method, "scene": {"name": name, "path": str(scene), "factor": 1, "sha256": state}}
        (folder / "config.yaml").write_text(yaml.safe_dump(config))
        for view in TEST:
            photo = cv2.imread(str(scene / "images" / view))
            cv2.imwrite(str(folder / "renders/test" / view), cv2.blur(photo, (2 * number + 1,) * 2))
    return scene, runs


def panel_key(methods: tuple[str, ...] = METHODS, views: int = 8) -> Key:
    """A key with every pair of methods on `views` views of two scenes, and two photos."""
    questions: dict[str, dict[str, str]] = {}
    for scene in ("yard", "hall"):
        for i, a in enumerate(methods):
            for b in methods[i + 1 :]:
                for view in range(views // 2):
                    questions[f"p{len(questions)}"] = {
                        "kind": "preference", "scene": scene, "view": str(view), "x": a, "y": b}  # fmt: skip
    for view in range(2):
        questions[f"k{view}"] = {"kind": "ambiguity", "scene": "yard", "view": str(view)}
    return Key("abc123", "A study", questions)


def write_key(key: Key, path: Path) -> Path:
    path.write_text(json.dumps({"format": KEY_FORMAT, "version": 1, **vars(key)}))
    return path


def panel(
    key: Key, strengths: dict[str, float], raters: int, rng: np.random.Generator, ties: float = 0.0
) -> dict[str, dict[str, Any]]:
    """Answer files by rater: preferences as Bradley and Terry have them, a share of ties, ratings of 4."""
    files = {}
    for number in range(raters):
        answers = []
        for question, entry in key.questions.items():
            if entry["kind"] == "ambiguity":
                answers.append({"question": question, "answer": "4", "ms": 900})
                continue
            better = 1 / (1 + np.exp(strengths[entry["y"]] - strengths[entry["x"]]))
            choice = "tie" if rng.random() < ties else ("x" if rng.random() < better else "y")
            left = "x" if rng.random() < 0.5 else "y"
            answers.append({"question": question, "answer": choice, "left": left, "ms": 1500})
        files[f"r{number}"] = {
            "format": "aw-study-answers", "version": 1, "study": key.study, "rater": f"r{number}",
            "name": f"person {number}", "answers": answers}  # fmt: skip
    return files


def write_panel(files: dict[str, dict[str, Any]], folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        (folder / f"{name}.json").write_text(json.dumps(data))
    return folder
