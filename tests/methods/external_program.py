"""Somebody else's method, as a program: `train` remembers the photos, `render` draws the nearest one.

It knows nothing of this project: it reads the COLMAP text model, the photos and its own split
file, and writes pictures where it likes. The tests of the adapter run it for real.
"""

import argparse
import json
import os
import shutil
import sys
import time
from pathlib import Path


def positions(scene: Path) -> dict[str, float]:
    """Camera x by photo; the poses of the tiny scene only step sideways."""
    lines = (scene / "sparse/0/images.txt").read_text().splitlines()[::2]
    return {words[9]: -float(words[5]) for words in (line.split() for line in lines)}


def train(arguments: argparse.Namespace) -> None:
    scene, output = Path(arguments.scene), Path(arguments.output)
    (scene / "sparse/0/points3D.ply").write_text("a cache beside the model, as 3DGS writes one")
    test = (scene / "sparse/0/test.txt").read_text().split()
    state = {
        "photos": {name: x for name, x in positions(scene).items() if name not in test},
        "images": str(scene / arguments.images),
        "seed": arguments.seed,
        "gain": float(os.environ.get("GAIN", "1")),
    }
    print(f"training {arguments.iterations} iterations\r50%\r100%")
    if arguments.stop_after_start and not (output / "begun").exists():
        (output / "begun").touch()
        print("out of luck", file=sys.stderr)
        sys.exit(3)
    if arguments.sleep:
        time.sleep(arguments.sleep)
    (output / "state.json").write_text(json.dumps(state))
    (output / "trained.txt").open("a").write("once\n")
    shutil.copyfile(arguments.splats, output / "splats.ply") if arguments.splats else None


def render(arguments: argparse.Namespace) -> None:
    scene, output = Path(arguments.scene), Path(arguments.output)
    state = json.loads((output / "state.json").read_text())
    test = (scene / "sparse/0/test.txt").read_text().split()
    folder = output / "test" / "ours_7" / "renders"
    folder.mkdir(parents=True, exist_ok=True)
    here = positions(scene)
    for index, name in enumerate(sorted(test)):
        nearest = min(state["photos"], key=lambda n: (abs(state["photos"][n] - here[name]), n))
        draw(
            Path(state["images"]) / nearest,
            folder / f"{index:05d}{arguments.suffix}",
            state["gain"],
            arguments,
        )
    if arguments.truth:  # keep maps: what another program thinks, here the answer itself
        (output / "masks").mkdir(exist_ok=True)
        for path in Path(arguments.truth).glob("*.png"):
            invert(path, output / "masks" / path.name)


def draw(photo: Path, target: Path, gain: float, arguments: argparse.Namespace) -> None:
    if gain == 1.0 and not arguments.half_size and target.suffix == photo.suffix:
        shutil.copyfile(photo, target)
        return
    import cv2  # takes longer than all the rest

    picture = cv2.convertScaleAbs(cv2.imread(str(photo)), alpha=gain)
    cv2.imwrite(str(target), picture[::2, ::2] if arguments.half_size else picture)


def invert(mask: Path, target: Path) -> None:
    import cv2

    cv2.imwrite(str(target), 255 - cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("step", choices=["train", "render"])
    parser.add_argument("--scene")
    parser.add_argument("--output")
    parser.add_argument("--images", default="images")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--iterations", type=int, default=1)
    parser.add_argument("--suffix", default=".png")
    parser.add_argument("--truth", default="")
    parser.add_argument("--splats", default="")
    parser.add_argument("--sleep", type=float, default=0.0)
    parser.add_argument("--half-size", action="store_true")
    parser.add_argument("--stop-after-start", action="store_true")
    arguments = parser.parse_args()
    {"train": train, "render": render}[arguments.step](arguments)


if __name__ == "__main__":
    main()
