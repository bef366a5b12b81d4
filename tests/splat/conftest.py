"""What the tests of this folder share: the tiny scene, and a stand-in for gsplat."""

import pytest

from ambiguous_wild.io.scene_folder import load_scene

from . import fake_gsplat


@pytest.fixture(scope="session")
def scene(scene):
    """With distractors; read only."""
    return load_scene(scene)


@pytest.fixture
def fake(monkeypatch):
    """gsplat is a stand-in, and the CPU counts as an accelerator."""
    with fake_gsplat.installed(monkeypatch):
        yield
