"""A scene that would give a wrong number is refused by whatever opens it; a doubt is said once."""

import ast
import dataclasses
import importlib
import inspect
import re
import shutil
import warnings
from pathlib import Path

import click
import cv2
import numpy as np
import pytest

import ambiguous_wild
from ambiguous_wild.builder.scene_package import list_files
from ambiguous_wild.builder.stages import Stages
from ambiguous_wild.cli.main import cli
from ambiguous_wild.core import AwError, SparsePoints
from ambiguous_wild.harness import mask_plan
from ambiguous_wild.io.files import write_json
from ambiguous_wild.io.scene_checks import MAX_POINTS, check_scene
from ambiguous_wild.io.scene_folder import load_scene
from tests.command_line import ROOT, aw
from tests.tiny_scene import FOCAL, HEIGHT, TEST, TRAIN, WIDTH, write_tiny_scene


def train_photo_as_test(root: Path) -> None:
    shutil.copy(root / "images" / TRAIN[0], root / "images" / TEST[0])


def train_photo_again_as_jpeg(root: Path) -> None:
    """Other bytes, the same pose and nearly the same picture."""
    photo = cv2.imread(str(root / "images" / TRAIN[0]))
    coded = cv2.imencode(".jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, 97])[1]
    cv2.imwrite(str(root / "images" / TEST[0]), cv2.imdecode(coded, cv2.IMREAD_COLOR))
    text = (root / "sparse/0/images.txt").read_text()
    pose = re.search(rf"^\d+ (.*) {TRAIN[0]}$", text, re.M)[1]
    (root / "sparse/0/images.txt").write_text(
        re.sub(rf"^(\d+) .* {TEST[0]}$", rf"\1 {pose} {TEST[0]}", text, flags=re.M)
    )


def alpha(root: Path, *names: str) -> None:
    for name in names:
        photo = cv2.imread(str(root / "images" / name))
        shown = np.full((HEIGHT, WIDTH), 255, np.uint8)
        shown[:9] = 0
        cv2.imwrite(str(root / "images" / name), np.dstack([photo, shown]))


def one_pose(root: Path) -> None:
    cameras(root, pose="1 0 0 0 0 0 0")


def points_at(root: Path, xyz: str) -> None:
    lines = (root / "sparse/0/points3D.txt").read_text().splitlines()
    moved = [" ".join([(w := line.split())[0], *(xyz.split() or w[1:4]), *w[4:]]) for line in lines]
    (root / "sparse/0/points3D.txt").write_text("\n".join(moved) + "\n")


def points_behind(root: Path) -> None:
    text = (root / "sparse/0/points3D.txt").read_text()
    (root / "sparse/0/points3D.txt").write_text(text.replace(" 4.0 ", " -4.0 "))


def masks(root: Path, *names: str) -> None:
    (root / "masks").mkdir()
    for name in names:
        half = np.full((HEIGHT, WIDTH), 255, np.uint8)
        half[:9] = 0
        cv2.imwrite(str(root / "masks" / name), half)


def cameras(root: Path, *, pose: str = "", focal_y: float = FOCAL, centre_x: float = WIDTH / 2) -> None:
    """Other intrinsics, and one pose for all photos."""
    text = f"1 PINHOLE {WIDTH} {HEIGHT} {FOCAL} {focal_y} {centre_x} {HEIGHT / 2}\n"
    (root / "sparse/0/cameras.txt").write_text(text)
    text = (root / "sparse/0/images.txt").read_text()
    posed = re.sub(r"^(\d+) 1 0 0 0 \S+ 0 0", rf"\1 {pose}", text, flags=re.M) if pose else text
    (root / "sparse/0/images.txt").write_text(posed)


def whatever_is_odd(root: Path) -> None:
    shutil.copy(root / "images" / TRAIN[4], root / "images" / TRAIN[5])
    alpha(root, TRAIN[1])
    train_photo_again_as_jpeg(root)
    cameras(root, focal_y=10 * FOCAL, centre_x=WIDTH + 1)
    masks(root, TRAIN[2], "typo.png")
    (root / "test_list.txt").write_text("\n".join([*TEST, *TEST]))
    text = (root / "sparse/0/images.txt").read_text()
    (root / "sparse/0/images.txt").write_text(text.replace("-0.75 0 0 1 train_3", "900 0 0 1 train_3"))


def one_photo(root: Path) -> None:
    (root / "train_list.txt").write_text(TRAIN[0])


def one_place(root: Path) -> None:
    cameras(root, pose=r"1 0 0 0.0\1 0 0 0")


RUNS = "looks at runs, whose scene was asked before they were trained"
# What every command and function that takes a path may open -> how it is called on SCENE. OURS is the scene
# with scene.json, ZIP its archive, RAW the photos of its lists, RUN and FILE a run and its model.
USES = {
    "simulate --like": "simulate --like SCENE --print-spec",
    "composite source": "composite SCENE --patches -o OUT",
    "import source": "import SCENE -o OUT",
    "export-scene scene": "export-scene SCENE --as on-the-go -o OUT",
    "ambiguity-report scene": "ambiguity-report SCENE -o OUT",
    "plan scene": "plan SCENE --no-probe -o OUT.json",
    "bench --scene": "bench --method 3dgs --scene SCENE --iterations 1 --effects none --effects poses -o OUT",
    "ablate --scene": "ablate --method absgs --scene SCENE --sweep grow_grad=0.0004 -o FILE",  # no folder
    "cost --recommend": "cost RUN --recommend SCENE 1m",
    "study make --scene": "study make --scene SCENE -o OUT.html",
    "view --scene": "view FILE --scene SCENE -o OUT",
    "video --scene": "video FILE --scene SCENE --seconds 0.1 --width 16 -o OUT.mp4",
    "export --scene": "export FILE --scene SCENE --no-loss --format spz -o OUT",
    "leaderboard add --scene": "leaderboard add RUN --scene SCENE --dataset toy --board OUT --dry-run",
    "package scenes": "package OURS --no-people -o OUT",
    "rescore --scene": "rescore RUN --scene SCENE",
    "verify package": "verify ZIP",
    "bench()": lambda on: ambiguous_wild.bench("3dgs", on["SCENE"], output=on["OUT"], iterations=1),
    "build_scene()": lambda on: ambiguous_wild.build_scene(on["RAW"], on["OUT"]),
    "load_scene()": lambda on: load_scene(on["SCENE"]),
    "plan()": lambda on: ambiguous_wild.plan(on["SCENE"]),
}
EXEMPT = {
    "try source": "its steps are commands of this table",
    "screen raw": "no scene yet; what photos alone show is refused as in build-scene",
    "build-scene raw": "calls build_scene()",
    "ambiguity-report --run": RUNS,
    "bench --start": "a splat file",
    "masks source": "its steps are commands of this table; the scene of a run was asked before",
    "export-scene --masks": RUNS,
    "figure runs": RUNS,
    "statement runs": RUNS,
    "table runs": RUNS,
    "cost runs": RUNS,
    "study make runs": RUNS,
    "study score answers": "no scene is opened",
    "view runs": RUNS,
    "view --live": "trains by bench(), once viser has opened its page",
    "video runs": RUNS,
    "explain run": RUNS,
    "export runs": RUNS,
    "leaderboard add runs": "their scene is opened as that of --scene",
    "package --info": "no scene",
    "rescore runs": "their scene is opened as that of --scene",
    "audit tables": "no scene is opened",
    "open_run()": RUNS,
    "read_runs()": RUNS,
    "table()": RUNS,
}

# Files that open a scene without its checks -> why.
UNASKED = {
    "cli/try_all.py": "a step before has built the scene",
    "datasets/export.py": "the same scene at another size",
    "datasets/package.py": "asked a few lines before",
    "harness/job.py": "asked by the process that sent the job",
    "harness/trained_models.py": RUNS,
    "report/suite_board.py": "runs of these scenes were made a step before",
    "simulate/composite_scene.py": "the same scene at another size",
}
OURS = {
    "package scenes",
    "verify package",
    "build_scene()",
}  # have scene.json: alpha and masks were read before


def commands(command, name=""):
    """Names of the commands' parameters that are paths and may be scenes."""
    if isinstance(command, click.Group):
        context = click.Context(command)
        for child in command.list_commands(context):
            yield from commands(command.get_command(context, child), f"{name} {child}".strip())
        return
    for param in command.params:
        types = param.type.types if isinstance(param.type, click.Tuple) else [param.type]
        about = f"{param.name} {param.metavar} {getattr(param, 'help', '')}".lower()
        asked = isinstance(param, click.Argument) or ("scene" in about and "-o" not in param.opts)
        if asked and any(isinstance(kind, click.Path) for kind in types):
            yield f"{name} {param.opts[0]}"


def functions():
    """Names of the functions that the package offers or its documentation imports, and that take a path."""
    named = {("ambiguous_wild", name) for name in ambiguous_wild._OFFERED}
    for page in [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md"]:
        for code in re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL):
            for module, names in re.findall(r"^from (ambiguous_wild[\w.]*) import (.+)$", code, re.MULTILINE):
                named |= {(module, name.strip()) for name in names.split(",")}
    for module, name in named:
        offered = getattr(importlib.import_module(module), name)
        if inspect.isfunction(offered):
            taken = inspect.signature(offered).parameters.values()
            if any("Path" in str(parameter.annotation) for parameter in taken):
                yield f"{name}()"


def test_every_entrance_has_a_row():
    assert {*commands(cli), *functions()} == USES.keys() | EXEMPT.keys()
    assert not USES.keys() & EXEMPT.keys()


def test_who_opens_a_scene_without_its_checks_says_why():
    package = Path(ambiguous_wild.__file__).parent
    unasked = set()
    for path in package.rglob("*.py"):
        text = path.read_text()
        for call in ast.walk(ast.parse(text)) if "check=" in text else ():
            if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "load_scene":
                unasked |= {path.relative_to(package).as_posix() for k in call.keywords if k.arg == "check"}
    assert unasked == UNASKED.keys()


def placed(scene, run, folder):
    """The paths that the rows of `USES` name, in `folder`."""
    folder.mkdir()
    own = shutil.copytree(scene, folder / "own" / "scene")
    write_json(own / "scene.json", {"schema_version": 1, "factor": 1, "files": list_files(own, 1)})
    archive = shutil.make_archive(str(folder / "scene"), "zip", own.parent, own.name)
    for side in ("train", "test"):
        (folder / "raw" / side).mkdir(parents=True)
        for name in set((scene / f"{side}_list.txt").read_text().split()):
            shutil.copy(scene / "images" / name, folder / "raw" / side)
    model = next(run.rglob("point_cloud.ply"))
    paths = {"SCENE": scene, "OURS": own, "ZIP": archive, "RAW": folder / "raw", "OUT": folder / "out"}
    return {**paths, "RUN": run, "FILE": shutil.copy(model, folder / "model.ply")}


def answer(entrance, on):
    """Exit code and lines of an entrance."""
    use = USES[entrance]
    if isinstance(use, str):
        places = "|".join(on)
        done = aw(*(re.sub(f"^({places})", lambda found: str(on[found[0]]), word) for word in use.split()))
        return done.returncode, f"{done.stdout}\n{done.stderr}".splitlines()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        try:
            use(on)
        except AwError as error:
            return AwError.exit_code, [str(error)]
    return 0, [str(warning.message) for warning in told]


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    """A build ends with the scene that lies beside its photos, a plan trains no probes."""
    monkeypatch.setattr(mask_plan, "with_masks", lambda plan, scene: plan)
    monkeypatch.setattr(Stages, "run", lambda self, work, seconds: self.capture.root.parent / "own" / "scene")


@pytest.mark.parametrize(
    ("spoil", "words", "legal"),
    [
        (train_photo_as_test, "test photos are training photos (test_0.png is train_0.png)", set()),
        (lambda root: alpha(root, *TEST), "alpha of test photos hides pixels", {*OURS, "import source"}),
        (one_pose, "all 6 cameras have one pose", set()),
        (lambda root: points_at(root, "0 0 4"), "all points of the sparse model lie at one place", set()),
        (points_behind, "no point of the sparse model lies in any training photo", set()),
        (
            lambda root: masks(root, "other.png"),
            "holds 1 mask, none of a photo of the scene (other.png)",
            OURS,
        ),
    ],
)
def test_a_scene_that_would_give_a_wrong_number_is_refused_everywhere(
    tmp_path, finished, spoil, words, legal
):
    scene = write_tiny_scene(tmp_path / "scene")
    spoil(scene)
    on = placed(scene, finished, tmp_path / "use")
    for entrance in USES.keys() - legal:  # none goes on to its work
        code, lines = answer(entrance, on)
        assert code == 2 and any(words in line for line in lines), (entrance, lines)
        assert not [*on["OUT"].parent.glob("out*")], entrance


DOUBTS = {  # fault -> what has to be said of it -> where the fault is gone
    whatever_is_odd: {
        "the lists name photos twice, which are used once: test_0.png, test_1.png": {"import source"},
        "training photos that are one file count more than others: train_4.png = train_5.png": set(),
        "focal lengths of x and y differ more than 2 times": set(),
        "principal points outside of the photos": set(),
        "the cameras of train_3.png lie far from all others": set(),
        "of one pose that look alike: test_0.png and train_0.png": set(),
        "alpha of training photos is used as keep masks": {*OURS, "import source"},
        "masks that belong to no photo: typo.png": OURS,
        "without a mask, so all of them trains: train_0.png": OURS,
    },
    one_photo: {"it has one training photo": set()},
    one_place: {"all cameras stand at one place": set()},
}


@pytest.mark.parametrize("entrance", USES)
@pytest.mark.parametrize("spoil", DOUBTS)
def test_what_is_only_unlikely_is_said_once(tmp_path, finished, spoil, entrance):
    scene = write_tiny_scene(tmp_path / "scene")
    spoil(scene)
    _, lines = answer(entrance, placed(scene, finished, tmp_path / "use"))
    for words, gone in DOUBTS[spoil].items():
        assert sum(words in line for line in lines) == (entrance not in gone), (words, lines)


def rewritten(root):
    """The pixels of a training photo in another file, at the pose of the test photo."""
    photo = cv2.imread(str(root / "images" / TRAIN[0]))
    cv2.imwrite(str(root / "images" / TEST[0]), photo, [cv2.IMWRITE_PNG_COMPRESSION, 0])


def nearly_one_pose(root):
    text = (root / "sparse/0/images.txt").read_text()
    text = re.sub(r"^(\d+) 1 0 0 0 \S+ 0 0", r"\1 1 0 0 0 0.0000000\1 0 0", text, flags=re.M)
    (root / "sparse/0/images.txt").write_text(text)


def nearly_one_point(root):
    points_at(root, "0 0 4")
    text = (root / "sparse/0/points3D.txt").read_text()
    (root / "sparse/0/points3D.txt").write_text(text.replace(" 0 0 4 ", " 0.000001 0 4 ", 1))


def few_points(root, count):
    """So many points of the wall, behind the cameras."""
    points_behind(root)
    lines = (root / "sparse/0/points3D.txt").read_text().splitlines()
    (root / "sparse/0/points3D.txt").write_text("\n".join(lines[:count]) + "\n")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (rewritten, r"test photos are training photos \(test_0.png is train_0.png\)"),
        (nearly_one_pose, "all 6 cameras have one pose"),
        (nearly_one_point, "all points of the sparse model lie at one place"),
        (lambda root: few_points(root, 10), "no point of the sparse model lies in any training photo"),
    ],
)
def test_what_is_equal_but_for_rounding_is_refused(tmp_path, spoil, words):
    spoil(write_tiny_scene(tmp_path / "scene"))
    with pytest.raises(AwError, match=words):
        load_scene(tmp_path / "scene")


@pytest.mark.parametrize("count", [9, 400])
def test_points_that_hardly_any_photo_shows_are_warned_of(tmp_path, count):
    root = write_tiny_scene(tmp_path / "scene")
    few_points(root, count)
    if count == 400:  # four are right
        path = root / "sparse/0/points3D.txt"
        path.write_text(path.read_text().replace(" -4.0 ", " 4.0 ", 4))
    with pytest.warns(UserWarning, match="less than 5% of the sparse model's points lie in any"):
        load_scene(root)


def test_a_scene_whose_sampled_points_are_not_in_view_is_not_refused(tmp_path):
    scene = load_scene(write_tiny_scene(tmp_path / "scene"))
    seen = np.repeat(scene.points.xyz[:1], 15_000, axis=0)
    assert len(seen) // MAX_POINTS == 3
    seen[::3] *= [1, 1, -1]
    points = SparsePoints.without_tracks(seen)
    (warning,) = check_scene(dataclasses.replace(scene, points=points))
    assert "less than 5%" in warning


def test_a_mask_of_one_grey_is_no_mask(tmp_path):
    from ambiguous_wild.io.images import read_mask

    cv2.imwrite(str(tmp_path / "grey.png"), np.full((8, 8), 128, np.uint8))
    with pytest.raises(AwError, match="no mask of black and white"):
        read_mask(tmp_path / "grey.png")
