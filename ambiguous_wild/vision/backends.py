"""Back ends by name: ``dinov2-small@252,blocks=6``, ``sam2-video``, ``grounded:person. car.``, ``graph``."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
from collections.abc import Callable
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.core.config import with_options
from ambiguous_wild.core.errors import unknown
from ambiguous_wild.core.weight_files import expanded
from ambiguous_wild.vision.protocols import Features, Instances
from ambiguous_wild.vision.weights import find, named

# name in a spec: name of the weights, see vision/weights.py
DINO = {
    "dinov2-small": "dinov2-small",
    "dinov2-base": "dinov2-base",
    "dinov2-small-registers": "dinov2-with-registers-small",
    "dinov2-base-registers": "dinov2-with-registers-base",
    "dino-vits16": "dino-vits16",
    "dino-vits8": "dino-vits8",
    "dino-vitb16": "dino-vitb16",
    "dino-vitb8": "dino-vitb8",
}
SAM = {
    "sam": "sam-vit-base",
    "sam-large": "sam-vit-large",
    "sam-huge": "sam-vit-huge",
    "sam2": "sam2.1-hiera-tiny",
    "sam2-small": "sam2.1-hiera-small",
    "sam2-base-plus": "sam2.1-hiera-base-plus",
    "sam2-large": "sam2.1-hiera-large",
}
SAM_VIDEO = {
    "sam2-video": "sam2.1-hiera-tiny",
    "sam2-small-video": "sam2.1-hiera-small",
    "sam2-base-plus-video": "sam2.1-hiera-base-plus",
    "sam2-large-video": "sam2.1-hiera-large",
}
CONV = ("efficientnet-lite0", "vgg16")  # of weights, features and instances alike
FEATURES = ("labhog", "sceneconv", *CONV, *DINO)
INSTANCES = ("graph", *CONV, *SAM, *SAM_VIDEO, "grounded", "grounded-video", "labels")
_OPTION = re.compile(r",\s*([A-Za-z_][\w.]*)=([^,]*)$")


@dataclasses.dataclass(frozen=True)
class Spec:
    """A back end as written: ``name[@size][:argument][,key=value...]``."""

    name: str
    size: int | None
    argument: str  # after the colon: a prompt or a folder, "" = none
    options: dict[str, str]


def parse(text: str) -> Spec:
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
    return Spec(name.strip(), int(size) if at else None, argument.strip(), dict(reversed(options.items())))


def check_features(spec: str) -> None:
    """Check that the name of the features is known; nothing is loaded.

    Raises:
        AwError: an unknown name (names the nearest), or an invalid spec.
    """
    found = parse(spec)
    if found.name not in FEATURES:
        raise unknown("features", found.name, FEATURES)


def check_instances(spec: str) -> None:
    """As `check_features`, for instances."""
    found = parse(spec)
    if found.name not in INSTANCES:
        raise unknown("instances", found.name, INSTANCES)


def make_features(spec: str) -> Features:
    """Features by name.

    ``labhog``; ``sceneconv``, trained on the scene; one of `CONV` with ``@px`` (longer side; 0 = the
    photo's), ``layer=``, ``fit_photos=`` and ``weights=FOLDER``; or one of `DINO`, with ``@px``, ``blocks=``,
    ``normalise=``, ``fit_photos=`` and ``weights=FOLDER``.

    Raises:
        AwError: unknown name (names the nearest) or option; the weights are missing.
    """
    check_features(spec)
    found = parse(spec)
    if found.argument:
        raise AwError(f"features {spec!r}: {found.name} takes nothing after a colon; remove it")
    if found.name == "labhog":
        from ambiguous_wild.vision.labhog import LabHog

        _no_options(found, spec)
        return LabHog()
    if found.name == "sceneconv":
        from ambiguous_wild.vision.sceneconv import SceneConv, SceneConvConfig

        if found.size is not None:
            raise AwError(f"features {spec!r}: sceneconv takes no size")
        return SceneConv(with_options(SceneConvConfig(), found.options, "option of sceneconv"))
    folder, options = _weights(found.options)
    if found.name in CONV:
        from ambiguous_wild.vision.convnets import ConvConfig, ConvFeatures

        conv = with_options(ConvConfig(), options, f"option of {found.name}")
        if found.size is not None:
            conv = dataclasses.replace(conv, size=found.size)
        return ConvFeatures(found.name, conv, folder)
    from ambiguous_wild.vision.dino import DinoConfig, DinoFeatures

    config = with_options(DinoConfig(), options, f"option of {found.name}")
    if found.size is not None:
        config = dataclasses.replace(config, size=found.size)
    return DinoFeatures(DINO[found.name], config, folder)


def make_instances(spec: str) -> Instances:
    """Instances by name; the result may also implement `NamedInstances` or `SceneInstances`.

    ``graph``; one of `CONV`: graph segments grouped by its features; one of `SAM` (``@n`` = points along a
    side) or `SAM_VIDEO`; ``grounded:PROMPT`` and, tracked over a sequence, ``grounded-video:PROMPT``;
    ``labels:FOLDER`` (``scene_wide=true`` if all photos share its ids). Options are the fields of the back
    end's config, and ``weights=FOLDER``.

    Raises:
        AwError: unknown name (names the nearest) or option; the weights or the folder are missing.
    """
    check_instances(spec)
    found = parse(spec)
    if found.argument and found.name not in ("grounded", "grounded-video", "labels"):
        raise AwError(f"instances {spec!r}: {found.name} takes nothing after a colon; remove it")
    return _BUILDERS.get(found.name, _sam)(found, spec)


def _graph(found: Spec, spec: str) -> Instances:
    from ambiguous_wild.vision.segments import GraphSegments, SegmentConfig

    if found.size is not None:
        raise AwError(f"instances {spec!r}: graph takes no size")
    return GraphSegments(with_options(SegmentConfig(), found.options, "option of graph"))


def _grouped(found: Spec, spec: str) -> Instances:
    from ambiguous_wild.vision.convnets import ConvConfig, ConvFeatures
    from ambiguous_wild.vision.segments import GroupConfig, GroupedSegments

    folder, options = _weights(found.options)
    network = {k: v for k, v in options.items() if k == "layer"}
    own = {k: v for k, v in options.items() if k not in network}
    config = with_options(GroupConfig(), own, f"option of {found.name}")
    features = with_options(ConvConfig(), network)
    if found.size is not None:
        features = dataclasses.replace(features, size=found.size)
    return GroupedSegments(ConvFeatures(found.name, features, folder), config)


def _labels(found: Spec, spec: str) -> Instances:
    from ambiguous_wild.vision.label_maps import LabelMaps, SceneLabelMaps

    if found.size is not None or not found.argument:
        raise AwError(f"instances {spec!r}: write labels:FOLDER")
    flag = found.options.get("scene_wide", "false").lower()
    if set(found.options) - {"scene_wide"}:
        raise unknown("option of labels", next(iter(set(found.options) - {"scene_wide"})), ["scene_wide"])
    if flag not in ("true", "false"):
        raise AwError(f"instances {spec!r}: scene_wide is true or false, got {flag!r}")
    return (SceneLabelMaps if flag == "true" else LabelMaps)(found.argument)


def _grounded(found: Spec, spec: str) -> Instances:
    from ambiguous_wild.vision.grounded import GroundedConfig, GroundedInstances

    folder, options = _weights(found.options)
    sam_folder, options = _weights(options, "sam_weights")
    tracking = {}
    if found.name == "grounded-video":
        tracking = {k: v for k, v in options.items() if k in ("every", "most", "known")}
        options = {k: v for k, v in options.items() if k not in tracking}
    config = with_options(GroundedConfig(), options, "option of grounded")
    if found.size is not None:
        config = dataclasses.replace(config, shorter=found.size)
    instances = GroundedInstances(found.argument, config, folder=folder, sam_folder=sam_folder)
    if found.name == "grounded":
        return instances
    from ambiguous_wild.vision.sam_video import SamVideoConfig, SamVideoInstances

    video = with_options(SamVideoConfig(sam=config.sam), tracking, "option of grounded-video")
    return SamVideoInstances(SAM_VIDEO["sam2-video"], video, sam_folder, instances)


def _sam(found: Spec, spec: str) -> Instances:
    folder, options = _weights(found.options)
    where = f"option of {found.name}"
    if found.name in SAM:
        from ambiguous_wild.vision.sam import SamConfig, SamInstances

        config = with_options(SamConfig(), options, where)
        if found.size is not None:
            config = dataclasses.replace(config, grid=found.size)
        return SamInstances(SAM[found.name], config, folder)
    from ambiguous_wild.vision.sam_video import SamVideoConfig, SamVideoInstances

    video = with_options(SamVideoConfig(), options, where)
    if found.size is not None:
        video = dataclasses.replace(video, sam=dataclasses.replace(video.sam, grid=found.size))
    return SamVideoInstances(SAM_VIDEO[found.name], video, folder)


_BUILDERS: dict[str, Callable[[Spec, str], Instances]] = {
    "graph": _graph,
    **dict.fromkeys(CONV, _grouped),
    "labels": _labels,
    "grounded": _grounded,
    "grounded-video": _grounded,
}


def _weights(options: dict[str, str], key: str = "weights") -> tuple[Path | None, dict[str, str]]:
    """The folder an option names, and the other options."""
    rest = {k: v for k, v in options.items() if k != key}
    return (expanded(options[key], key) if key in options else None), rest


def _no_options(found: Spec, spec: str) -> None:
    if found.options or found.size is not None:
        raise AwError(f"features {spec!r}: {found.name} takes no options")


# Metadata of an option whose default depends on the machine: a command that repeats a run elsewhere names it.
BY_MACHINE = {"by_machine": True}


def first_here(*specs: str) -> str:
    """The first of these specs that can run here, the last without asking; nothing is loaded."""
    return next((spec for spec in specs[:-1] if _can_run(parse(spec).name)), specs[-1])


def _can_run(name: str) -> bool:
    """Whether the weights are here, and the package that runs them."""
    if name in CONV:
        return find(named(name))[0] is not None
    weights = (DINO | SAM).get(name)
    if weights is None:
        return True
    return find(named(weights))[0] is not None and importlib.util.find_spec("transformers") is not None
