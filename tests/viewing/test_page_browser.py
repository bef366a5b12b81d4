"""The page in a real browser, opened from a file: pictures against our renders, every control, no request."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from ambiguous_wild.harness.trained_models import Viewer, view_runs
from ambiguous_wild.io.images import write_png
from ambiguous_wild.io.ply import read_splat_ply
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.io.splat_arrays import SplatFile
from ambiguous_wild.viewing.model import Renderer, RenderSettings, ViewedModel
from ambiguous_wild.viewing.page_file import page_text
from ambiguous_wild.viewing.video import fitted
from tests.chromium import Browser, needs_chromium
from tests.tiny_scene import TEST, TRAIN, write_tiny_scene
from tests.viewing.open_page import box, facts, mouse, settle
from tests.viewing.wall_runs import wall_model, write_shown_run

pytestmark = [pytest.mark.slow, needs_chromium]
HOSTILE = "</script><img src=x onerror=alert(1)>"
FACE = """(() => {
  const face = over.frusta.children.findLast((c) => c.visible).children[1];
  face.geometry.computeBoundingSphere();
  const p = face.geometry.boundingSphere.center.clone().applyMatrix4(face.matrixWorld).project(camera);
  const b = over.element.getBoundingClientRect();
  return [b.x + (p.x + 1) / 2 * b.width, b.y + (1 - p.y) / 2 * b.height];
})()"""
# Red and green inside the mask's square and outside of it.
PIXELS = """(() => {
  const c = document.querySelector("#photo canvas");
  const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
  const at = (x, y) => 4 * (y * c.width + x);
  return [d[at(20, 20)], d[at(20, 20) + 1], d[at(50, 40)], d[at(50, 40) + 1]];
})()"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("flown")
    scene = write_tiny_scene(root / "porch")
    write_shown_run(root / "runs", scene, "3dgs", 0, noise=20.0)
    write_shown_run(root / "runs", scene, HOSTILE, 1, noise=5.0)
    write_png(scene / "map.png", np.full((86, 130, 3), 200, np.uint8))
    view_runs([root / "runs"], root / "view", title=HOSTILE)
    return root


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile"), width=800, height=560, webgl=True) as page:
        yield page


@pytest.fixture
def page(runs: Path, browser: Browser) -> Browser:
    browser.open("about:blank#")  # a page with the same address would not load again
    browser.open((runs / "view" / "index.html").as_uri() + f"#left=3dgs&right=x&mode=single&view={TEST[0]}")
    settle(browser)
    return browser


def shot(page: Browser, tmp_path: Path) -> np.ndarray:
    """The stage's picture without labels and frames, RGB."""
    over = "for (const e of document.querySelectorAll('#photo, #frame, .pane span, #handle, #slider'))"
    page.run(f"{over} e.style.visibility = 'hidden'")
    page.screenshot(tmp_path / "shot.png")
    page.run(f"{over} e.style.visibility = ''")
    image = cv2.imread(str(tmp_path / "shot.png"))[:, :, ::-1]
    x, y, w, h = box(page)
    return image[y : y + h, x : x + w]


def ours(runs: Path, label: str, view: str, size: tuple[int, int]) -> np.ndarray:
    """Our own render of what the stage shows."""
    scene = load_scene(runs / "porch")
    camera = next(v.camera for v in scene.views if v.name == view)
    seed = 0 if label == "3dgs" else 1
    (ply,) = (runs / "runs").glob(f"porch/*/seed{seed}/point_cloud.ply")
    return Renderer(read_splat_ply(ply), RenderSettings())(fitted(camera, size, camera.cam_from_world))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return 10 * math.log10(255**2 / np.mean((a.astype(float) - b) ** 2))


@pytest.mark.parametrize("label", ["3dgs", HOSTILE])
def test_what_it_draws_is_what_we_render(runs: Path, page: Browser, tmp_path: Path, label: str) -> None:
    index = facts(page, f"DATA.models.findIndex((m) => m.label === {json.dumps(label)})")
    page.run(f"choose({{ left: {index} }}).then(() => 1)")
    for view in TEST:
        page.run(f"choose({{ view: DATA.views.findIndex((v) => v.name === '{view}') }}).then(() => 1)")
        settle(page)
        drawn = shot(page, tmp_path)
        assert psnr(drawn, ours(runs, label, view, (drawn.shape[1], drawn.shape[0]))) > 30
    assert page.requests == [(runs / "view" / "index.html").as_uri()] and page.errors == []


def test_every_control(runs: Path, page: Browser, tmp_path: Path) -> None:
    assert page.run("$('said').textContent").startswith("test photo · ")
    for mode in ("beside", "cut", "single"):
        page.click(f"#{mode}")
        settle(page)
        assert page.run("$('stage').dataset.mode") == mode
        assert page.run(f"$('{mode}').getAttribute('aria-pressed')") == "true"
    # Side by side: the same camera draws both halves.
    page.click("#beside")
    settle(page)
    said = page.run("$('said').textContent")
    assert said.count(" dB") == 2 and HOSTILE in said
    for control in ("#chart", "#map"):  # shown by the button, hidden by a click on it
        page.click(control)
        assert page.run("$('map').hidden") == (control == "#map")
        assert page.run("$('chart').getAttribute('aria-pressed')") == str(control == "#chart").lower()
    both = shot(page, tmp_path)
    half = both.shape[1] // 2
    labels = facts(page, "DATA.models.map((m) => m.label)")
    for at, label in ((0, labels[0]), (half, labels[1])):
        wanted = ours(runs, label, page.run("DATA.views[state.view].name"), (half, both.shape[0]))
        assert psnr(both[:, at : at + half], wanted) > 30
    # The slider: left of it one model, right of it the other.
    page.click("#cut")
    page.run("$('slider').value = 25; $('slider').dispatchEvent(new Event('input'))")
    settle(page)
    cut = shot(page, tmp_path)
    height, width = cut.shape[:2]
    view = page.run("DATA.views[state.view].name")
    first, second = (ours(runs, label, view, (width, height)) for label in labels[:2])
    at = width // 4
    assert (
        psnr(cut[:, : at - 3], first[:, : at - 3]) > 30 and psnr(cut[:, at + 3 :], second[:, at + 3 :]) > 30
    )
    assert page.errors == []


def test_cameras_are_frusta_that_can_be_clicked(page: Browser, tmp_path: Path) -> None:
    page.click("#home")
    settle(page)
    assert page.run("state.view") is None and page.run("$('view').value") == ""
    plain = shot(page, tmp_path)
    page.click("#frusta")
    page.until("over.frusta.children.every((f) => f.children[1].material.map)")
    settle(page)
    drawn = shot(page, tmp_path)
    blue = (drawn[:, :, 2] > 200) & (drawn[:, :, 0] < 140)
    assert blue.sum() > 30 and np.abs(drawn.astype(float) - plain).mean() > 0.3
    x, y = facts(page, FACE)  # the middle of a face on the screen
    for kind in ("mousePressed", "mouseReleased"):
        mouse(page, kind, x, y, button="left", clickCount=1)
    page.until("state.view !== null")
    settle(page)
    assert page.run("DATA.views[state.view].split") == "train"
    assert page.errors == []


def test_masks_are_painted_over_the_photo(page: Browser) -> None:
    page.run(f"choose({{ view: DATA.views.findIndex((v) => v.name === '{TRAIN[0]}') }}).then(() => 1)")
    settle(page)
    before = page.run(PIXELS)
    assert "mask of" in page.run("document.querySelector('#photo figcaption').textContent")
    page.click("#masks")
    page.until("!document.querySelector('#photo figcaption').textContent.includes('mask of')")
    after = page.run(PIXELS)
    assert before[1] < 0.6 * after[1] and before[0] >= after[0] - 1  # inside the mask: red
    assert before[2:] == after[2:]  # outside: the photo


def test_the_photo_can_stand_beside_a_model(page: Browser, tmp_path: Path) -> None:
    page.run("choose({ mode: 'beside', right: PHOTO }).then(() => 1)")
    settle(page)
    shown = shot(page, tmp_path)
    half = shown.shape[1] // 2
    left, right = shown[:, :half].astype(float), shown[:, half : 2 * half].astype(float)
    covered = right.sum(axis=2) > 0
    assert covered.mean() > 0.3 and np.abs(left - right)[covered].mean() < 30
    assert page.run("$('photo').hidden")


def test_keys_mouse_and_wheel_move_the_camera(page: Browser) -> None:
    first = page.run("state.view")
    page.key("ArrowRight")
    page.until(f"state.view === {first} + 1")
    page.key("2")
    page.until("state.left === 1")
    page.key("v")
    page.until("state.mode === 'beside'")
    page.key("c")
    page.until("state.frusta")
    page.run("choose({ mode: 'single', frusta: false }).then(() => 1)")
    x, y, w, h = box(page)
    before = facts(page, "camera.position.toArray()")
    middle, later = (x + w / 2, y + h / 2), (x + w / 2 + 60, y + h / 2 + 20)
    mouse(page, "mousePressed", *middle, button="left", clickCount=1)
    mouse(page, "mouseMoved", *later, button="left", buttons=1)
    mouse(page, "mouseReleased", *later, button="left")
    page.until("state.view === null")
    settle(page)
    turned = facts(page, "camera.position.toArray()")
    assert np.linalg.norm(np.subtract(turned, before)) > 0.05
    mouse(page, "mouseWheel", *middle, deltaX=0, deltaY=-240)
    page.until(f"camera.position.distanceTo(new T.Vector3(...{json.dumps(turned)})) > 0.02")
    page.run("document.dispatchEvent(new KeyboardEvent('keydown', { key: 'w', bubbles: true }))")
    at = facts(page, "camera.position.toArray()")
    page.until(f"camera.position.distanceTo(new T.Vector3(...{json.dumps(at)})) > 0.02")
    page.run("document.dispatchEvent(new KeyboardEvent('keyup', { key: 'w', bubbles: true }))")
    assert page.errors == []


def test_a_camera_path_is_saved_for_the_video(page: Browser, runs: Path, tmp_path: Path) -> None:
    for _ in range(3):
        page.click("#next")
        settle(page)
        page.key("p")
    assert page.run("$('path').textContent") == "Path (3)"
    (tmp_path / "path.json").write_text(page.run("JSON.stringify(pathFile())"))
    from ambiguous_wild.viewing import video

    scene = load_scene(runs / "porch")
    cameras = video.from_file(tmp_path / "path.json", scene, 3, (64, 48))
    names = [*TEST, *TRAIN]
    for camera, name in zip(cameras, names[1:4]):
        wanted = next(v.camera for v in scene.views if v.name == name)
        assert np.allclose(camera.cam_from_world, wanted.cam_from_world, atol=1e-4)


def test_the_address_opens_a_place(page: Browser, runs: Path) -> None:
    page.open("about:blank#")
    place = f"#left=3dgs&right=photo&mode=cut&view={TRAIN[2]}&x=<b>"
    page.open((runs / "view" / "index.html").as_uri() + place)
    settle(page)
    assert page.run("DATA.models[state.left].label") == "3dgs" and page.run("state.right") == "photo"
    assert page.run("state.mode") == "cut" and page.run("DATA.views[state.view].name") == TRAIN[2]


def test_a_page_of_a_training_loads_itself_again_where_the_person_was(
    runs: Path, browser: Browser, tmp_path: Path
) -> None:
    scene, path = load_scene(runs / "porch"), tmp_path / "index.html"
    model = ViewedModel("3dgs", Path("3dgs"), splats=SplatFile(wall_model()))

    def write(training: str, reload_s: float) -> None:
        path.write_text(page_text(scene, [model], title="t", training=training, reload_s=reload_s)[0])

    write("training: 1 iteration", 0.2)
    browser.open(path.as_uri())
    settle(browser)
    # with unsaved work it stays
    browser.key("p")
    browser.until("$('training').textContent.includes('not refreshed')")
    place = "camera.position.set(...[1, 2, 3].map((x, i) => x + DATA.middle[i] - 4 * (i === 2)))"
    browser.run(f"home(), {place}, controls.update(), choose({{ mode: 'cut', right: PHOTO, masks: false }})")
    eye = facts(browser, "camera.position.toArray()")
    write("training: 2 iterations", 1000)
    browser.run("state.path = []")
    loaded = "typeof DATA === 'object' && Boolean(controls) && DATA.training === "
    browser.until(f"{loaded}'training: 2 iterations'")
    settle(browser)
    assert facts(browser, "[state.mode, state.right, state.view, state.masks]") == [
        "cut",
        "photo",
        None,
        False,
    ]
    assert np.allclose(facts(browser, "camera.position.toArray()"), eye, atol=1e-3)
    # a training that was killed writes no page any more
    browser.run("sessionStorage.setItem(KEY, JSON.stringify([DATA.training, MOST_RELOADS]))")
    browser.run("DATA.reload_s = 0.2")
    browser.until(
        f"{loaded}'training: 2 iterations' && $('training').textContent.includes('waits no longer')"
    )
    write("training: 3 iterations", 1000)
    browser.run("location.reload()")
    browser.until(f"{loaded}'training: 3 iterations' && $('training').textContent.includes('next state')")
    write("", 0)  # the last page
    browser.run("DATA.reload_s = 0.2")
    browser.until(f"{loaded}''")
    settle(browser)
    assert browser.run("state.mode") == "cut" and browser.run("$('training').offsetHeight") == 0
    browser.run("window.same = 1")
    time.sleep(0.6)
    assert browser.run("window.same") == 1 and browser.errors == []


def test_a_notebook_s_frame_shows_it_too(runs: Path, browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "notebook.html").write_text(f"<!doctype html>{Viewer([runs / 'runs'])._repr_html_()}")
    browser.open((tmp_path / "notebook.html").as_uri())
    # The frame is another origin: what it draws is all that can be seen of it.
    end = time.monotonic() + 60
    while True:
        browser.screenshot(tmp_path / "shot.png")
        image = cv2.imread(str(tmp_path / "shot.png"))
        if image[250:400, 100:500].std() > 20:
            break
        assert time.monotonic() < end, browser.errors
        time.sleep(0.5)


def test_nothing_hostile_ran_and_it_fits_a_phone(runs: Path, tmp_path: Path) -> None:
    with Browser(tmp_path / "phone", width=360, height=640, mobile=True, webgl=True) as page:
        page.open((runs / "view" / "index.html").as_uri())
        settle(page)
        assert page.run("document.querySelectorAll('img').length") == 0
        assert page.run("document.title") == f"{HOSTILE} · aw"
        assert page.run("document.querySelector('h1').textContent") == f"{HOSTILE} · aw"
        assert page.run("document.documentElement.scrollWidth <= innerWidth")
        assert page.run("!under.renderer")
        assert page.run("document.querySelector('header').offsetHeight <= 0.15 * innerHeight")
        # nothing is cut at the side: the other controls are behind a button
        assert page.run("$('beside').offsetHeight") == 0
        page.click("#more")
        sides = "[...document.querySelectorAll('header button, header select')].filter((e) => e.offsetHeight)"
        assert page.run(
            f"{sides}.length > 10 && {sides}.every((e) => e.getBoundingClientRect().right <= innerWidth)"
        )
        page.click("#more")
        x, y, w, h = box(page)
        before = facts(page, "camera.position.toArray()")
        for kind, dx in (("touchStart", 0), ("touchMove", 30), ("touchMove", 70), ("touchEnd", None)):
            points = [] if dx is None else [{"x": x + w / 2 + dx, "y": y + h / 2}]
            page.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        page.until("state.view === null")
        page.until(f"camera.position.distanceTo(new T.Vector3(...{json.dumps(before)})) > 0.02")
        assert page.errors == []
