"""Descriptions of methods for `aw methods NAME` and `aw methods --table`. Imports no torch.

They come from the recipe's docstring, its options with their comments, and a table of the parts of each
built-in method.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib.util
import inspect
import io
import textwrap
import tokenize
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ambiguous_wild.core.config import Facts, to_plain
from ambiguous_wild.methods.entry import MethodEntry

Source = Literal["", "code", "code, in part", "summaries"]


@dataclass(frozen=True)
class Traits:
    """A few words about every part of a method; "" = as in 3DGS, or none."""

    masks: str = ""
    appearance: str = ""  # what changes colours by photo; fitted to test photos, or read from them
    density: str = ""
    state: str = ""  # what is learnt or stored beside the Gaussians of 3DGS
    cpu_only: bool = False  # True: it needs a statistic that gsplat does not offer
    # the facts come from the authors' code, a part of it, or summaries of the paper; "" = not stated
    source: Source = ""
    published: str = ""  # features or instances that the release uses


_PAPER = Traits(
    "entropy of features, by instance and pixel", "", "late; merging", "net of identities",
    source="summaries", published="DINOv2 ViT-S/14, instances with ids of a video",
)  # fmt: skip
BUILTIN_TRAITS = {
    "3dgs": Traits(source="code"),
    "3dgs+motion": Traits(masks="features that fit another motion than the place's"),
    "3dgs+truth": Traits(masks="exact"),
    "3dgs-clean": Traits(),
    "refinesplat": Traits(
        "structure of pixels and instances, other views", "", "late; merging; support", "",
        source="summaries", published="DINOv2 ViT-S/14, instances with ids of a video",
    ),
    "refinesplat-paper": _PAPER,
    "refinesplat-printed": _PAPER,
    "robustsplat": Traits(
        "net on features", "", "late", "mask net", source="code", published="DINOv2 ViT-S/14 with registers",
    ),
    "dronesplat": Traits("instances with high residuals", source="code, in part", published="SAM 2"),
    "spotlesssplats": Traits(
        "net on features", "", "no resets; harmonics cut; may prune by use", "mask net", source="code",
        published="Stable Diffusion (DIFT), 1280 channels",
    ),
    "spotlesssplats-cluster": Traits(
        "vote in clusters of features", "", "no resets; harmonics cut", "", source="code",
        published="Stable Diffusion (DIFT), 1280 channels",
    ),
    "wildgaussians": Traits(
        "uncertainty of features", "net on codes of both", "", "24 numbers a Gaussian, 32 a photo, head",
        source="code", published="DINOv2 ViT-S/14 with registers",
    ),
    "gs-w": Traits(
        "U-Net on the photo", "net on maps of the photo", "higher threshold", "54 numbers a Gaussian, nets",
        source="code", published="ResNet-18 (ImageNet), VGG-16 in the loss",
    ),
    "splatfacto-w": Traits(
        "largest residuals", "net on codes; background", "absolute gradient",
        "72 numbers a Gaussian, 48 a photo, nets", source="code",
    ),
    "swag": Traits(
        "", "net on place and photo; gates", "", "hash grid, 24 numbers a photo", source="summaries",
    ),
    "nexussplats": Traits(
        "uncertainty drawn as a colour", "net on codes", "no resets",
        "56 numbers a Gaussian, 64 a photo, nets", source="code", published="DINOv2 ViT-S/14 with registers",
    ),
    "desplat": Traits("layer of the photo", "", "", "Gaussians of every photo", source="code"),
    "hybridgs": Traits(
        "2D layer of the photo", "", "", "2D Gaussians of every photo", source="code, in part",
    ),
    "t-3dgs": Traits(
        "divergence of predicted errors", "", "", "head on features, last masks", source="code",
        published="DINOv2 ViT-S/14 with FeatUp; SAM 2 in its second stage",
    ),
    "forestsplats": Traits(
        "net on the photo, superpixels", "", "", "transient field, deformation and mask nets",
        source="code, in part",
    ),
    "asymgs": Traits(
        "instances and a learnt map in turn", "", "every 1000", "slow average of the model", source="code",
        published="DINOv2 patch embedding, Semantic-SAM",
    ),
    "asymgs-twin": Traits(
        "instances; a learnt map for the twin", "", "every 1000", "a second model", source="code",
        published="DINOv2 patch embedding, Semantic-SAM",
    ),
    "mip-splatting": Traits(density="resets the filtered opacity", state="filter size", source="code"),
    "absgs": Traits(density="absolute gradient splits", source="code"),
    "mcmc": Traits(density="fixed number, relocation, noise", source="code"),
    "pup-3dgs": Traits(density="pruning by sensitivity", source="code"),
    "uad": Traits(density="by size and mask of the footprint", cpu_only=True, source="summaries"),
}  # fmt: skip


COLUMNS = ("method", "masks", "appearance", "density", "extra state", "back ends", "facts from")
BACK_ENDS = "features", "instances"  # options that name a back end of vision/backends.py


@dataclass(frozen=True)
class Option:
    """An option of a method."""

    key: str  # dotted, as after METHOD. in --set
    default: str
    comment: str  # from its definition; "" = none


def recipe_text(entry: MethodEntry) -> str:
    """Return the docstring of the recipe's module, which is not imported."""
    if not isinstance(entry.recipe, str):
        return ""  # a file may hold many methods: each has its summary
    spec = importlib.util.find_spec(entry.recipe.partition(":")[0])
    if spec is None or spec.origin is None:
        return ""
    return ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or ""


def options_of(entry: MethodEntry) -> list[Option]:
    """Return every option with its default; options of parts, such as density control, have dotted keys."""
    return _options(entry.options(), "")


def _options(config: Any, prefix: str) -> list[Option]:
    options, comments = [], _comments(type(config))
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        if dataclasses.is_dataclass(value):
            options += _options(value, f"{prefix}{f.name}.")
        else:
            options.append(Option(prefix + f.name, _short(to_plain(value)), comments.get(f.name, "")))
    return options


def _comments(cls: type) -> dict[str, str]:
    by_field: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        try:
            source = textwrap.dedent(inspect.getsource(base))
        except (OSError, TypeError):  # a class that was made at run time has no source, e.g. that of a graft
            continue
        comment_at = {
            token.start[0]: token.string.lstrip("#").strip()
            for token in tokenize.generate_tokens(io.StringIO(source).readline)
            if token.type == tokenize.COMMENT
        }
        own_line = {k for k, line in enumerate(source.splitlines(), 1) if line.lstrip().startswith("#")}
        for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                first = node.lineno
                while first - 1 in own_line:
                    first -= 1
                last = node.end_lineno or node.lineno
                words = [comment_at[k] for k in range(first, last + 1) if k in comment_at]
                if words:
                    by_field[node.target.id] = " ".join(words)
    return by_field


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ",".join(map(_short, value)) or "()"
    return f"{value:g}" if isinstance(value, float) else str(value)


def table_row(entry: MethodEntry) -> tuple[str, ...]:
    """Return the cells of a method, in the columns of `COLUMNS`."""
    traits = BUILTIN_TRAITS.get(entry.name)
    if entry.program is not None:
        return (entry.name, "", "", "", "", "its own program", "")
    if traits is None:
        return (entry.name, "?", "?", "?", "?", "CPU, GPU?", "?")
    places = "CPU" if traits.cpu_only else "CPU, GPU"
    parts = (traits.masks, traits.appearance, traits.density, traits.state)
    return (entry.name, *(part or "-" for part in parts), places, traits.source or "-")


def details(entry: MethodEntry) -> Facts:
    """Return everything that is known about a method, ready for JSON."""
    options = [] if entry.program is not None else options_of(entry)
    traits = BUILTIN_TRAITS.get(entry.base or entry.name, Traits())
    once = dataclasses.replace(entry, name=entry.base or entry.name)
    runs_with = {o.key: o.default for o in options if o.key.rpartition(".")[2] in BACK_ENDS}
    return {
        "name": entry.name,
        "summary": entry.summary,
        "paper": entry.paper,
        "cite": entry.cite,
        "needs": entry.needs,
        "recipe": entry.recipe if isinstance(entry.recipe, str) else "",
        "about": "" if entry.program is not None else recipe_text(entry),
        "parts": dict(zip(COLUMNS[1:], table_row(once)[1:])),
        "published_with": traits.published,
        "runs_with": runs_with,
        "options": [dataclasses.asdict(option) for option in options],
        "ablations": [
            {"name": g.name, "title": g.title, "variants": [v.name for v in g.variants]}
            for g in entry.ablation_groups()
        ],
        "passes": entry.passes,
    }
