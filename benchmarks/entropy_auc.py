"""How well the printed entropy and other statistics find distractors, with each back end.

    python benchmarks/entropy_auc.py --captures DIR... --out DIR [--backends labhog sceneconv ...]
        [--iterations 700] [--max-gaussians 12000] [--sigma sigmoid] [--results FILE]

A DIR is a scene folder or a folder of them; scenes need exact masks. On each a plain 3DGS is trained and its
renders of the train views are compared with the photos. Area under the ROC curve (0.5 = chance, below it the
statistic is higher on static parts) of each statistic: on pixels, and on instances (distractors are those
with over half of their pixels in the mask). Entropies are those of psi(phi(render)).

It also gives the size of the gradients that L_id and L_cr send into the render, over that of L_GS: the L2
norm over all pixels, mean of the views.

Finished scenes and back ends are kept under --out, in a folder per settings. Writes
benchmarks/results/entropy-auc.md.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
from job_queue import exit_code, find_scenes
from scipy.stats import rankdata

from ambiguous_wild.core import AwError
from ambiguous_wild.harness.regions import exact_distractor
from ambiguous_wild.io.files import write_json, write_text
from ambiguous_wild.io.scene_folder import load_scene
from ambiguous_wild.methods import get_method
from ambiguous_wild.methods.refinesplat.evidence import ratio, uncertainty
from ambiguous_wild.methods.refinesplat.inputs import FrozenInputs
from ambiguous_wild.methods.refinesplat.masks import enlarge, instance_means
from ambiguous_wild.methods.refinesplat.paper import PaperConfig
from ambiguous_wild.methods.refinesplat.recipe import consistency_loss, identity_loss, instance_matrix
from ambiguous_wild.methods.refinesplat.threshold import cross_entropy, entropy, kl_divergence
from ambiguous_wild.splat.cpu import set_threads
from ambiguous_wild.splat.data import load_train_data
from ambiguous_wild.splat.losses import photometric
from ambiguous_wild.splat.step import TrainData
from ambiguous_wild.splat.train_config import TrainConfig
from ambiguous_wild.splat.trainer import Trainer
from ambiguous_wild.vision.backends import CONV, make_features, make_instances

RESULTS = Path(__file__).parent / "results" / "entropy-auc.md"
BACKENDS = ("labhog", "efficientnet-lite0", "vgg16", "sceneconv")
STATISTICS = ("entropy", "surprise", "contrast", "distance", "U / H", "residual")
BOX = 5  # px, of the residual


def auc(values: np.ndarray, positive: np.ndarray) -> float | None:
    """Area under the ROC curve; ties count half. None without both kinds."""
    count, rest = int(positive.sum()), int((~positive).sum())
    if not count or not rest:
        return None
    ranks = rankdata(values)
    return float((ranks[positive].sum() - count * (count + 1) / 2) / (count * rest))


def renders_of(data: TrainData, folder: Path, args: argparse.Namespace) -> list[torch.Tensor]:
    """Renders [H, W, 3] of the train views by a plain 3DGS."""
    config = TrainConfig(iterations=args.iterations, seed=0, max_gaussians=args.max_gaussians, probes=0)
    entry = get_method("3dgs")
    trainer = Trainer(data, entry.build(entry.options()), config, folder=folder)
    while trainer.iteration < args.iterations:
        trainer.step()
    steps = (trainer.make_step(args.iterations, view) for view in range(len(data.photos)))
    return [step.rendered.image.detach() for step in steps]


def instances_of(backend: str) -> str:
    """The instances that go with features."""
    return backend if backend in CONV else "graph"


def judged(data: TrainData, renders: Sequence[torch.Tensor], backend: str, sigma: Any) -> dict[str, Any]:
    """AUC of every statistic and sizes of gradients with one back end."""
    config = PaperConfig(features=backend, instances=instances_of(backend))
    config = dataclasses.replace(config, mask=dataclasses.replace(config.mask, variant=sigma))
    features = make_features(backend)
    inputs = FrozenInputs(data, features, make_instances(config.instances), config)
    found = inputs.semantics
    pixels: dict[str, list[np.ndarray]] = {name: [] for name in STATISTICS}
    grouped: dict[str, list[np.ndarray]] = {name: [] for name in STATISTICS}
    truth, guilty, sizes = [], [], []
    for view, render in enumerate(renders):
        mask = exact_distractor(data.scene, data.scene.train[view])
        if mask is None:
            continue
        maps = _maps(found, view, render, data.photos[view], features, sigma)
        labels, count = torch.from_numpy(inputs.labels[view]), inputs.counts[view]
        share, areas = (t.numpy() for t in instance_means(torch.from_numpy(mask), labels, count))
        truth.append(mask.ravel())
        guilty.append(share[areas > 0] > 0.5)
        for name, grid in maps.items():
            pixels[name].append(enlarge(grid, *mask.shape).numpy().ravel())
            grouped[name].append(instance_means(grid, labels, count)[0].numpy()[areas > 0])
        sizes.append(_gradients(data, found, inputs.counts[view], view, render, features, sigma))
    if not truth:
        raise AwError(f"{data.scene.name} has no exact masks of its train photos (truth/distractor)")
    flat, bad = np.concatenate(truth), np.concatenate(guilty)
    return {
        "instances": config.instances,
        "identities": found.association.count,
        "instances_per_photo": fmean(inputs.counts),
        "pixels": {name: auc(np.concatenate(v), flat) for name, v in pixels.items()},
        "by_instance": {name: auc(np.concatenate(v), bad) for name, v in grouped.items()},
        "gradient_id": fmean(a for a, _ in sizes),
        "gradient_cr": fmean(b for _, b in sizes),
    }


@torch.no_grad()
def _maps(
    found: Any, view: int, render: torch.Tensor, photo: torch.Tensor, features: Any, sigma: Any
) -> dict[str, torch.Tensor]:
    phi = features(render)
    mine, theirs = found.psi(phi), found.psi(found.phi[view])
    cosine = torch.cosine_similarity(found.phi[view], phi, dim=2)
    residual = (render - photo).abs().mean(2)[None, None]
    h = entropy(mine, sigma)
    boxed = torch.nn.functional.avg_pool2d(residual, BOX, 1, BOX // 2, count_include_pad=False)[0, 0]
    maps = {
        "entropy": h,
        "surprise": cross_entropy(mine, theirs, sigma),
        "contrast": kl_divergence(mine, theirs, sigma),
        "distance": 1.0 - cosine,
        "residual": boxed,
    }
    maps = {name: value.double() for name, value in maps.items()}
    return maps | {"U / H": ratio(uncertainty(cosine.double()), maps["entropy"])}


def _gradients(
    data: TrainData, found: Any, count: int, view: int, render: torch.Tensor, features: Any, sigma: Any
) -> tuple[float, float]:
    """Norms of dL_id/dimage and dL_cr/dimage (all pixels kept), over that of dL_GS/dimage."""
    base = float(photometric(render, data.photos[view], None).d_image.norm())
    norms = []
    for which in ("id", "cr"):
        image = render.clone().requires_grad_(True)
        logits = found.psi(features(image)).flatten(0, 1)
        if which == "id":
            ids = found.identities[view].reshape(-1)
            loss = identity_loss(logits, ids, torch.ones(len(ids)), sigma)
        else:
            loss = consistency_loss(logits, instance_matrix(found.grid[view].reshape(-1), count), sigma)
        (gradient,) = torch.autograd.grad(loss, image)
        norms.append(float(gradient.norm()) / base)
    return norms[0], norms[1]


def to_markdown(data: dict[str, Any]) -> str:
    def number(value: float | None) -> str:
        return "-" if value is None else f"{value:.3f}"

    lines = [
        "# Statistics of each back end: area under the ROC curve",
        "",
        f"Renders of a plain 3DGS after {data['iterations']} iterations with at most {data['max_gaussians']} "
        f"Gaussians; sigma: {data['sigma']}. Pixels / instances. Made by `benchmarks/entropy_auc.py`.",
        "",
        "| capture | features | " + " | ".join(STATISTICS) + " | L_id | L_cr |",
        "|---" * (len(STATISTICS) + 4) + "|",
    ]
    for row in data["rows"]:
        cells = [f"{number(row['pixels'][s])} / {number(row['by_instance'][s])}" for s in STATISTICS]
        cells += [f"{row['gradient_id']:.1f}", f"{row['gradient_cr']:.1f}"]
        lines.append(f"| {row['scene']} | {row['features']} | " + " | ".join(cells) + " |")
    lines += ["", "L_id, L_cr: L2 norm of the gradient to the render, over that of L_GS, weights of 1."]
    return "\n".join(lines) + "\n"


def arguments(words: Sequence[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--captures", nargs="+", type=Path, required=True, metavar="DIR")
    parser.add_argument("--out", type=Path, required=True, help="folder of what is finished")
    parser.add_argument("--backends", nargs="+", default=list(BACKENDS))
    parser.add_argument("--iterations", type=int, default=700)
    parser.add_argument("--max-gaussians", type=int, default=12_000)
    parser.add_argument("--sigma", choices=("sigmoid", "softmax"), default="sigmoid")
    parser.add_argument("--results", type=Path, default=RESULTS, help="where the table goes")
    return parser.parse_args(words)


def rows_of(root: Path, args: argparse.Namespace) -> list[dict[str, Any]]:
    """A row per back end of one scene; those that are kept are not computed again."""
    scene = load_scene(root)
    kept = args.out / f"{args.iterations}-{args.max_gaussians}-{args.sigma}" / scene.name
    todo = [backend for backend in args.backends if not (kept / f"{backend}.json").is_file()]
    if todo:
        with tempfile.TemporaryDirectory() as name:
            data = load_train_data(scene, device=torch.device("cpu"), seed=0, cache_dir=Path(name))
            renders = renders_of(data, Path(name) / "run", args)
            for backend in todo:
                row = {"scene": scene.name, "features": backend}
                row |= judged(data, renders, backend, args.sigma)
                write_json(kept / f"{backend}.json", row)
                print(json.dumps(row), flush=True)
    return [json.loads((kept / f"{backend}.json").read_text(encoding="utf-8")) for backend in args.backends]


def main(words: Sequence[str] | None = None) -> int:
    args = arguments(words)
    set_threads(1)
    torch.set_num_threads(1)
    rows = [row for root in find_scenes(args.captures) for row in rows_of(root, args)]
    table = to_markdown({**vars(args), "rows": rows})
    write_text(args.results, table)
    print(table)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
