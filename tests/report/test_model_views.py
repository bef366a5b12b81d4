"""The page of a run that is trained: written on the way, and once more where the run is stopped."""

from __future__ import annotations

import json
import re

import pytest

from ambiguous_wild import bench
from ambiguous_wild.harness.callbacks import Callbacks
from ambiguous_wild.io.files import sha256_file
from ambiguous_wild.report import model_views
from ambiguous_wild.report.model_views import GrowingPage


class Pages(Callbacks):
    """Keeps every page that is written."""

    def __init__(self, page):
        self.page, self.written = page, []

    def started(self, cell, folder):
        self.page.begin(cell.method.name)

    def tick(self, trainer):
        if self.page.tick(trainer):
            self.written.append((trainer.iteration, data_of(self.page)))


def data_of(page):
    text = (page.folder / "index.html").read_text()
    return json.loads(re.search(r'<script id="data" type="application/json">(.*?)</script>', text, re.S)[1])


def test_a_page_grows_with_its_run_and_shows_those_that_ended(scene, finished, tmp_path, monkeypatch):
    monkeypatch.setattr(model_views, "FIRST_PAGE_S", 0.0)
    monkeypatch.setattr(model_views, "LONGEST_PAUSE_S", 0.0)
    monkeypatch.setattr(model_views, "LEAST_PAUSE", 0.0)
    pages = Pages(GrowingPage(tmp_path / "view", finished))
    words = {"output": tmp_path / "runs", "effects": "none", "device": "cpu", "threads": 1, "pictures": False}
    bench("refinesplat", scene, iterations=5, callbacks=pages, **words)
    assert [iteration for iteration, _ in pages.written] == [1, 2, 3, 4]  # the last is that of the result
    for iteration, data in pages.written:
        assert [model["label"] for model in data["models"]] == ["3dgs", "refinesplat"]
        assert data["training"].startswith(f"{iteration} iterations in ")
        assert data["reload_s"] > 0 or iteration == 1  # when the time to write a page is not known yet
    assert pages.page.end()
    data = data_of(pages.page)
    assert data["training"].startswith("stopped: 5 iterations") and data["reload_s"] == 0


@pytest.mark.parametrize("method", ["3dgs", "refinesplat", "robustsplat", "dronesplat", "wildgaussians"])
def test_writing_pages_changes_nothing_in_a_run(scene, tmp_path, monkeypatch, method):
    monkeypatch.setattr(model_views, "FIRST_PAGE_S", 0.0)
    monkeypatch.setattr(model_views, "LONGEST_PAUSE_S", 0.0)
    monkeypatch.setattr(model_views, "LEAST_PAUSE", 0.0)
    models = []
    for name, callbacks in (
        ("with", Pages(GrowingPage(tmp_path / "view", tmp_path / "none"))),
        ("without", None),
    ):
        report = bench(
            method, scene, output=tmp_path / name, iterations=12, callbacks=callbacks,
            effects="none", device="cpu", threads=1, pictures=False,
        )  # fmt: skip
        models.append(sha256_file(report.runs[0].folder / "point_cloud.ply"))
    assert models[0] == models[1]


def test_a_page_that_cannot_be_written_ends_no_training(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(model_views, "FIRST_PAGE_S", 0.0)
    pages = Pages(GrowingPage(tmp_path / "view", tmp_path / "none"))
    (tmp_path / "view").write_text("in the way")
    report = bench("3dgs", scene, output=tmp_path / "runs", iterations=3, callbacks=pages, effects="none",
                   device="cpu", threads=1, pictures=False)  # fmt: skip
    assert report.outcomes == {"trained": 1} and not pages.written


def test_no_page_is_written_of_a_run_that_has_not_begun(tmp_path):
    page = GrowingPage(tmp_path / "view", tmp_path / "runs")
    page.begin("refinesplat")
    assert not page.end() and not (tmp_path / "view").exists()
