"""Train one method on one scene with as few packages as that takes, and render the test views.

    python -m ambiguous_wild.harness.train_alone SCENE -o runs --method 3dgs

For a machine that holds a GPU and little else: plain 3DGS needs torch, gsplat, safetensors, numpy and OpenCV
or Pillow. The run folder is the one `aw bench` would have made: where every package is, it goes on from
there.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.running.cell import Cell
from ambiguous_wild.harness.running.environment import environment
from ambiguous_wild.harness.running.identity import scene_identity
from ambiguous_wild.harness.running.memory import is_out_of_gpu_memory, out_of_gpu_memory
from ambiguous_wild.io.atomic import atomic_dir, write_json, write_text
from ambiguous_wild.io.images import to_uint8, write_png
from ambiguous_wild.io.lock import folder_lock
from ambiguous_wild.io.ply import write_splat_ply
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods.registry import get_method
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.gpu import readiness
from ambiguous_wild.splat.pace import TrainConfig
from ambiguous_wild.splat.trainer import Trainer

CONFIG = "config.yaml"  # written as JSON, which is YAML too: a reader of YAML may be absent here
_PACKAGES = {"cv2": "opencv-contrib-python-headless", "skimage": "scikit-image"}  # by what is imported


def train_alone(cell: Cell, output: Path, say: Callable[[str], None] = lambda text: None) -> Path:
    """Train the cell, or go on from its last checkpoint; effects are not switched on.

    Args:
        cell: what to run.
        output: as of `aw bench`.
        say: told now and then how far it is.

    Returns:
        The run folder with point_cloud.ply, renders/test, timeline.csv and the checkpoint.

    Raises:
        AwError: the folder holds another run.
        ModuleNotFoundError: the method needs a package that is missing.
    """
    folder = output / cell.scene.name / cell.method.name / f"seed{cell.train.seed}"
    with folder_lock(folder, "train_alone"):
        if folder.exists() and _identity(folder) != cell.identity:
            raise AwError(f"{folder} holds a run of another configuration, or none; choose another -o")
        folder.mkdir(parents=True, exist_ok=True)
        config = cell.config | {"config_hash": cell.identity}
        write_text(folder / CONFIG, json.dumps(config, indent=2, ensure_ascii=False) + "\n")
        write_json(folder / "env.json", environment(cell.device))
        device, cache = torch.device(cell.device), output / ".cache"
        data = load_train_data(cell.scene, device=device, seed=cell.train.seed, cache_dir=cache)
        trainer = Trainer(data, cell.method.build(cell.options), cell.train, folder=folder)
        trainer.resume()
        trainer.train(tick=_Lines(say))
        _write(trainer, folder)
    return folder


def _identity(folder: Path) -> str | None:
    try:
        return json.loads((folder / CONFIG).read_text(encoding="utf-8")).get("config_hash")
    except (OSError, ValueError, AttributeError):
        return None


def _write(trainer: Trainer, folder: Path) -> None:
    model = {name: tensor.cpu().numpy() for name, tensor in trainer.neutral_model().items()}
    write_splat_ply(folder / "point_cloud.ply", model)
    with atomic_dir(folder / "renders" / "test") as temporary:
        for view in trainer.data.scene.test:
            path = temporary / Path(view.name).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, to_uint8(trainer.render(view.camera).image.cpu().numpy()))


class _Lines:
    """A line each twentieth of the run."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self.say, self.told = say, -1

    def __call__(self, trainer: Trainer) -> None:
        share = int(20 * trainer.progress(trainer.iteration))
        if share > self.told:
            self.told = share
            self.say(
                f"{5 * share} %: iteration {trainer.iteration}, {trainer.ms_per_iteration:.1f} ms/iteration, "
                f"{len(trainer.gaussians):,} Gaussians"
            )


def main(words: Sequence[str] | None = None) -> None:
    """Parse, train, print the run folder; a mistake of the user is one line and exit code 2."""
    parser = argparse.ArgumentParser(prog="python -m ambiguous_wild.harness.train_alone")
    parser.add_argument("scene", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("runs"))
    parser.add_argument("--method", default="3dgs")
    parser.add_argument("--iterations", type=_count, default=TrainConfig.iterations)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--factor", type=_count)
    parser.add_argument("--max-gaussians", type=_count)
    parser.add_argument("--device", choices=["auto", "cpu", "cuda"], default="auto")
    wanted = parser.parse_args(words)
    device = wanted.device
    try:
        device = readiness.choose(wanted.device, _say)
        entry, scene = get_method(wanted.method), load_scene(wanted.scene, factor=wanted.factor)
        train = TrainConfig(
            iterations=wanted.iterations, seed=wanted.seed, max_gaussians=wanted.max_gaussians
        )
        cell = Cell(entry, entry.options(), scene, scene_identity(scene), train, device)
        print(train_alone(cell, wanted.output, _say))
    except AwError as error:
        _fail(str(error))
    except ModuleNotFoundError as error:
        name = (error.name or "").partition(".")[0]
        command = f"{sys.executable} -m pip install {_PACKAGES.get(name, name)}"
        _fail(f"{wanted.method} on the {device} needs {name}, which is not installed: {command}")
    except OSError as error:
        _fail(f"{error.filename or 'input or output'}: {error.strerror or error}")
    except RuntimeError as error:
        if not is_out_of_gpu_memory(error):
            raise
        _fail(str(out_of_gpu_memory(error, None, wanted.factor)))


def _count(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text} is no number above zero")
    return number


def _fail(message: str) -> None:
    _say("error: " + " ".join(message.split()))
    sys.exit(AwError.exit_code)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
