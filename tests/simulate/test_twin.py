"""`aw simulate --like`: what is measured in a scene, and what the spec takes of it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ambiguous_wild.core.srgb import linear_to_srgb
from ambiguous_wild.harness.effects_plan import Evidence
from ambiguous_wild.report.twin import SPREAD_OF_STOP, Likeness, arc_of, noise_of, spec_like
from ambiguous_wild.simulate import image_effects as fx
from ambiguous_wild.simulate.image_effects import PhotoRandom
from ambiguous_wild.simulate.spec import Defocus, Effects
from ambiguous_wild.simulate.spec_file import dump_spec, parse_spec
from tests.command_line import aw

PLAIN = Evidence(0.0, 0.01, 1.2, 0.004, 5000, photos=30, outward=0.5)
LIKENESS = Likeness("a.scene", 4, (240, 180), 4, 0.6, 100.0, PLAIN, 0.0, 0.0, (0.0, 0.001, 0.004))


def test_a_plain_scene_calls_for_nothing() -> None:
    spec = spec_like(LIKENESS).spec
    assert spec.effects == Effects() and not spec.distractors and not spec.world.things
    assert (spec.name, spec.train_views, spec.test_views) == ("a-scene", 30, 4)
    assert (spec.width, spec.height, spec.walk, spec.zoom) == (960, 720, "around", (1.0, 1.0))
    assert parse_spec(dump_spec(spec)) == spec
    assert (spec_like(LIKENESS, 480).spec.height, spec_like(LIKENESS, 480).factor) == (360, 2)
    unknown = replace(PLAIN, exposure=math.nan, appearance=math.nan, sampling=math.nan, outward=math.nan)
    assert spec_like(replace(LIKENESS, evidence=unknown)).spec == spec


@pytest.mark.parametrize(
    ("evidence", "rest", "expected"),
    [
        ({}, {"soft": 0.2}, {"effects": Effects(defocus=Defocus(share=0.2))}),
        ({"outward": 7.0}, {"arc_deg": 340.0}, {"walk": "outward", "arc_deg": 340}),
        ({}, {"moving": (0.05, 0.1, 0.2)}, {"occlusion": (0.05, 0.2)}),
        ({}, {"size": (180, 240)}, {"width": 720, "height": 960}),
    ],
)
def test_what_is_measured_is_named(evidence: dict, rest: dict, expected: dict) -> None:
    of = replace(LIKENESS, evidence=replace(PLAIN, **evidence), **rest)
    assert {key: getattr(spec_like(of).spec, key) for key in expected} == expected


@pytest.mark.parametrize(
    ("seed", "measured", "wanted"), [(0, 0.1, 0.1), (1, 0.049, 0.0417), (1, 0.051, 0.06)]
)
def test_the_drawn_exposures_spread_as_measured_or_farther_from_the_limit(
    seed: int, measured: float, wanted: float
) -> None:
    of = replace(LIKENESS, evidence=replace(PLAIN, exposure=measured))
    drift = spec_like(of, seed=seed).spec.effects.exposure_drift
    assert drift is not None
    stops = [fx.draw_exposure_drift(drift, PhotoRandom(seed, k, k / 29)) for k in range(30)]
    assert np.std(stops, ddof=1) * SPREAD_OF_STOP == pytest.approx(wanted, rel=0.02)


def test_light_by_place_is_hours_of_the_day_and_replaces_exposure() -> None:
    of = replace(LIKENESS, evidence=replace(PLAIN, appearance=0.08, exposure=0.08))
    effects = spec_like(of).spec.effects
    assert effects.time_of_day is not None and effects.exposure_drift is None
    shiny = replace(of, evidence=replace(of.evidence, view_dependence=0.04))
    assert spec_like(shiny).spec.effects.time_of_day is None
    assert any("0.04" in line and "not simulated" in line for line in spec_like(shiny).lines)


def test_zoom_adds_what_the_walk_lacks() -> None:
    low, high = spec_like(replace(LIKENESS, evidence=replace(PLAIN, sampling=2.6))).spec.zoom
    assert low * high == pytest.approx(1, abs=0.02) and 3.2 < high / low < 4.2
    assert spec_like(replace(LIKENESS, evidence=replace(PLAIN, sampling=40.0))).spec.zoom == (0.5, 4.0)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 104.0, 300.0])
def test_an_arc_is_found_from_directions(degrees: float) -> None:
    angles = np.radians(np.linspace(-degrees / 2, degrees / 2, 2000))
    directions = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], axis=1)
    assert arc_of(directions) == pytest.approx(degrees, abs=1.0)


def test_noise_is_found_between_edges_and_the_iso_gives_it_back() -> None:
    rng = np.random.default_rng(0)
    columns = np.linspace(0.3, 0.6, 320)[None, :, None] + 0.2 * (np.arange(320) % 80 < 9)[None, :, None]
    clean = np.broadcast_to(columns, (240, 320, 3))
    assert noise_of(clean) < 1e-6
    assert noise_of(clean + 0.02 * rng.standard_normal(clean.shape)) == pytest.approx(0.02, rel=0.15)
    assert math.isnan(noise_of(np.ones((64, 64, 3))))
    noise = spec_like(replace(LIKENESS, noise=0.005)).spec.effects.iso_noise
    assert noise is not None  # four times as much in photos of four times the width
    grey = np.full((200, 200, 3), 0.2, np.float32)
    seen = linear_to_srgb(
        fx.iso_noise(grey, rng.standard_normal(grey.shape, np.float32), float(np.mean(noise.iso)))
    )
    assert seen.std() == pytest.approx(0.02, rel=0.05)


def test_a_scene_is_measured_printed_and_simulated(built: Path, tmp_path: Path) -> None:
    scene = built / "scene"
    printed = aw("simulate", "--like", scene, "--width", 96, "--print-spec")
    assert printed.returncode == 0, printed.stderr
    spec = parse_spec(printed.stdout)
    assert printed.stdout.startswith("# photos: ")
    done = aw("simulate", "--like", scene, "--width", 96, "-o", tmp_path / "raw")
    assert done.returncode == 0, done.stderr
    assert len(list((tmp_path / "raw/train").iterdir())) == spec.train_views
    assert Image.open(next((tmp_path / "raw/train").iterdir())).size == (96, spec.height)
    assert "next: aw build-scene" in done.stdout and "--factor" in done.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--like", "gone"], "there is no scene folder gone"),
        (["--like", "SCENE"], "too few tracks"),
        (["tiny", "--like", "SCENE"], "exclude each other"),
    ],
)
def test_mistakes_get_one_line_and_write_nothing(
    words: list[str], message: str, scene: Path, tmp_path: Path
) -> None:
    done = aw("simulate", *(w.replace("SCENE", str(scene)) for w in words), "-o", tmp_path / "raw")
    assert done.returncode == 2 and message in done.stderr and done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())
