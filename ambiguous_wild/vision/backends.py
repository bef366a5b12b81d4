"""Back ends by name: ``dinov2-small@252,blocks=6``, ``sam2-video``, ``grounded:person. car.``, ``graph``."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import with_options
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.core.weight_files import expanded
from ambiguous_wild.vision.protocols import Features, Instances
from ambiguous_wild.vision.weight_registry import DINO, SAM, SAM_VIDEO, find_weight, get_weight

# name in a spec -> name of the weights, see vision/weight_registry.py
CONV = ("efficientnet-lite0", "vgg16")  # the same names for weights, features and instances
FEATURES = ("labhog", "sceneconv", *CONV, *DINO)
INSTANCES = ("graph", *CONV, *SAM, *SAM_VIDEO, "grounded", "grounded-video", "labels")
Config = TypeVar("Config")
_OPTION = re.compile(r",\s*([A-Za-z_][\w.]*)=([^,]*)$")
# Metadata of an option whose default depends on the machine: a command that repeats a run elsewhere names it.
BY_MACHINE = {"by_machine": True}


@dataclasses.dataclass(frozen=True)
class BackendSpec:
    """A back end as written: ``name[@size][:argument][,key=value...]``."""

    name: str
    size: int | None
    argument: str  # after the colon: a prompt or a folder, "" = none
    options: dict[str, str]


def parse_spec(text: str) -> BackendSpec:
    """Parse a spec; options are read from its end, so that prompts may contain commas.

    Raises:
        AwError: the size is not a number, or an option is given twice.
    """
    rest, options = text.strip(), dict[str, str]()
    while match := _OPTION.search(rest):
        if match[1] in options:
            raise AwError(f"back end {text!r}: option {match[1]!r} is given twice; give it once")
        options[match[1]] = match[2].strip()
        rest = rest[: match.start()].rstrip()
    head, _, argument = rest.partition(":")
    name, at, size = head.partition("@")
    if at and not size.isdecimal():
        raise AwError(f"back end {text!r}: {size!r} is not a size; write whole px, as in dinov2-small@252")
    return BackendSpec(
        name.strip(), int(size) if at else None, argument.strip(), dict(reversed(options.items()))
    )


def check_features(spec: str) -> BackendSpec:
    """Parse a spec of features; nothing is loaded.

    Raises:
        AwError: an unknown name (names the nearest), or an invalid spec.
    """
    return _known("features", spec, FEATURES)


def check_instances(spec: str) -> BackendSpec:
    """Parse a spec of instances; raises like `check_features`."""
    return _known("instances", spec, INSTANCES)


def _known(kind: str, spec: str, names: tuple[str, ...]) -> BackendSpec:
    parsed = parse_spec(spec)
    if parsed.name not in names:
        raise unknown(kind, parsed.name, names)
    return parsed


def make_features(spec: str) -> Features:
    """Make the back end of features that a spec names.

    ``labhog``; ``sceneconv``, trained on the scene; one of `CONV` with ``@px`` (longer side; 0 = the
    photo's), ``layer=``, ``fit_photos=`` and ``weights=FOLDER``; or one of `DINO`, with ``@px``, ``blocks=``,
    ``normalise=``, ``fit_photos=`` and ``weights=FOLDER``.

    Raises:
        AwError: unknown name (names the nearest) or option; the weights are missing.
    """
    parsed = check_features(spec)
    if parsed.argument:
        raise AwError(f"features {spec!r}: {parsed.name} takes nothing after a colon; remove it")
    if parsed.name == "labhog":
        from ambiguous_wild.vision.labhog import LabHog

        _no_options(parsed, spec)
        return LabHog()
    if parsed.name == "sceneconv":
        from ambiguous_wild.vision.sceneconv import SceneConv, SceneConvConfig

        if parsed.size is not None:
            raise AwError(f"features {spec!r}: sceneconv takes no size")
        return SceneConv(with_options(SceneConvConfig(), parsed.options, "option of sceneconv"))
    folder, options = _weights(parsed.options)
    if parsed.name in CONV:
        from ambiguous_wild.vision.convnets import ConvConfig, ConvFeatures

        return ConvFeatures(parsed.name, _sized(ConvConfig(), parsed, options), folder)
    from ambiguous_wild.vision.dino import DinoConfig, DinoFeatures

    return DinoFeatures(DINO[parsed.name], _sized(DinoConfig(), parsed, options), folder)


def make_instances(spec: str) -> Instances:
    """Make the back end of instances that a spec names; it may be `SceneInstances`, too.

    ``graph``; one of `CONV`: graph segments grouped by its features; one of `SAM` (``@n`` = points along a
    side) or `SAM_VIDEO`; ``grounded:PROMPT`` and, tracked over a sequence, ``grounded-video:PROMPT``;
    ``labels:FOLDER`` (``scene_wide=true`` if all photos share its ids). Options are the fields of the back
    end's config, and ``weights=FOLDER``.

    Raises:
        AwError: unknown name (names the nearest) or option; the weights or the folder are missing.
    """
    parsed = check_instances(spec)
    if parsed.argument and parsed.name not in ("grounded", "grounded-video", "labels"):
        raise AwError(f"instances {spec!r}: {parsed.name} takes nothing after a colon; remove it")
    builders: dict[str, Callable[[BackendSpec, str], Instances]] = {
        "graph": _graph,
        **dict.fromkeys(CONV, _grouped),
        "labels": _labels,
        "grounded": _grounded,
        "grounded-video": _grounded,
    }
    return builders.get(parsed.name, _sam)(parsed, spec)


def _graph(parsed: BackendSpec, spec: str) -> Instances:
    from ambiguous_wild.vision.segments import GraphSegments, SegmentConfig

    if parsed.size is not None:
        raise AwError(f"instances {spec!r}: graph takes no size")
    return GraphSegments(with_options(SegmentConfig(), parsed.options, "option of graph"))


def _grouped(parsed: BackendSpec, spec: str) -> Instances:
    from ambiguous_wild.vision.convnets import ConvConfig, ConvFeatures
    from ambiguous_wild.vision.segments import GroupConfig, GroupedSegments

    folder, options = _weights(parsed.options)
    network = {k: v for k, v in options.items() if k == "layer"}
    own = {k: v for k, v in options.items() if k not in network}
    config = with_options(GroupConfig(), own, f"option of {parsed.name}")
    features = ConvFeatures(parsed.name, _sized(ConvConfig(), parsed, network), folder)
    return GroupedSegments(features, config)


def _labels(parsed: BackendSpec, spec: str) -> Instances:
    from ambiguous_wild.vision.label_maps import LabelMaps, SceneLabelMaps

    if parsed.size is not None or not parsed.argument:
        raise AwError(f"instances {spec!r}: write labels:FOLDER")
    flag = parsed.options.get("scene_wide", "false").lower()
    if set(parsed.options) - {"scene_wide"}:
        raise unknown("option of labels", next(iter(set(parsed.options) - {"scene_wide"})), ["scene_wide"])
    if flag not in ("true", "false"):
        raise AwError(f"instances {spec!r}: scene_wide is true or false, got {flag!r}")
    return (SceneLabelMaps if flag == "true" else LabelMaps)(parsed.argument)


def _grounded(parsed: BackendSpec, spec: str) -> Instances:
    from ambiguous_wild.vision.grounded import GroundedConfig, GroundedInstances

    folder, options = _weights(parsed.options)
    sam_folder, options = _weights(options, "sam_weights")
    tracking = {}
    if parsed.name == "grounded-video":
        tracking = {k: v for k, v in options.items() if k in ("every", "most", "known")}
        options = {k: v for k, v in options.items() if k not in tracking}
    config = _sized(GroundedConfig(), parsed, options, "shorter")
    instances = GroundedInstances(parsed.argument, config, folder=folder, sam_folder=sam_folder)
    if parsed.name == "grounded":
        return instances
    from ambiguous_wild.vision.sam_video import SamVideoConfig, SamVideoInstances

    video = with_options(SamVideoConfig(sam=config.sam), tracking, "option of grounded-video")
    return SamVideoInstances(SAM_VIDEO["sam2-video"], video, sam_folder, instances)


def _sam(parsed: BackendSpec, spec: str) -> Instances:
    folder, options = _weights(parsed.options)
    if parsed.name in SAM:
        from ambiguous_wild.vision.sam import SamConfig, SamInstances

        return SamInstances(SAM[parsed.name], _sized(SamConfig(), parsed, options, "grid"), folder)
    from ambiguous_wild.vision.sam_video import SamVideoConfig, SamVideoInstances

    video = _sized(SamVideoConfig(), parsed, options, "sam.grid")
    return SamVideoInstances(SAM_VIDEO[parsed.name], video, folder)


def _sized(config: Config, parsed: BackendSpec, options: dict[str, str], size: str = "size") -> Config:
    """Return the config with these options, and with the spec's size as the option of this name."""
    sizes = {} if parsed.size is None else {size: str(parsed.size)}
    return with_options(config, options | sizes, f"option of {parsed.name}")


def _weights(options: dict[str, str], key: str = "weights") -> tuple[Path | None, dict[str, str]]:
    """Return the folder that the option `key` names, if it is given, and the other options."""
    rest = {k: v for k, v in options.items() if k != key}
    return (expanded(options[key], key) if key in options else None), rest


def _no_options(parsed: BackendSpec, spec: str) -> None:
    if parsed.options or parsed.size is not None:
        raise AwError(f"features {spec!r}: {parsed.name} takes no options")


def first_available(*specs: str) -> str:
    """Return the first of these specs that can run on this machine, else the last; nothing is loaded."""
    return next((spec for spec in specs[:-1] if _can_run(parse_spec(spec).name)), specs[-1])


def _can_run(name: str) -> bool:
    """Whether the weights are on this machine, and the package that runs them is installed."""
    if name in CONV:
        return find_weight(get_weight(name))[0] is not None
    weights = (DINO | SAM).get(name)
    if weights is None:
        return True
    return (
        find_weight(get_weight(weights))[0] is not None
        and importlib.util.find_spec("transformers") is not None
    )
