"""`aw weights check`: whether the weights on this machine are complete and are those that were published."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ambiguous_wild.core import AwError
from ambiguous_wild.vision import weight_registry
from ambiguous_wild.vision.weight_conversion import check_file, check_folder
from ambiguous_wild.vision.weight_registry import Weight

_SIDE = 64  # px of the picture that features are computed for


@dataclass(frozen=True)
class WeightCheck:
    """The result of checking one of the weights."""

    name: str
    ok: bool
    detail: str  # what was checked, or what is wrong


def verify(weight: Weight) -> WeightCheck:
    """Load the weights, every tensor by name and shape, and compare hashes where they are known.

    Features are also computed once. Nothing is downloaded.
    """
    try:
        place = weight_registry.weight_path(weight)
        if place is None:
            raise AwError(weight_registry.missing_error(weight))
        advice = f"run: {weight_registry.get_command(weight.name)}"
        if weight.kind == "file":
            count, hashes = check_file(weight, place, advice), "sha256 as published"
        else:
            recorded = check_folder(weight, place, advice)
            count, hashes = _load(weight, place), "sha256 as downloaded"
            hashes = hashes if recorded else "no record of their sha256"
        return WeightCheck(weight.name, True, f"{count} tensors, {hashes}: {place}")
    except AwError as error:
        return WeightCheck(weight.name, False, str(error))


def _load(weight: Weight, folder: Path) -> int:
    """Load the model and return the number of its tensors."""
    from ambiguous_wild.vision.pretrained import load, locate

    if weight.used_for == "features":
        from ambiguous_wild.vision.dino import DinoFeatures

        features = DinoFeatures(weight.name, folder=folder)
        _try(features, weight.name)
        model = features.model
    elif weight.name.startswith("grounding"):
        from ambiguous_wild.vision.grounded import HARMLESS

        source = locate(weight.name, ("grounding-dino",), folder)
        model = load(source, "GroundingDinoForObjectDetection", harmless=HARMLESS)
    else:
        from ambiguous_wild.vision.sam import SamInstances

        model = SamInstances(weight.name, folder=folder).model
        if weight.name.startswith("sam2"):
            from ambiguous_wild.vision.sam_video import SamVideoInstances

            model = SamVideoInstances(weight.name, folder=folder).model
    return len(model.state_dict())


def _try(features: object, name: str) -> None:
    """Compute features of a picture; raise if they are not finite, or equal everywhere."""
    import torch

    ramp = torch.linspace(0, 1, _SIDE)
    image = torch.stack(
        [ramp.expand(_SIDE, -1), ramp[:, None].expand(-1, _SIDE), ramp.flip(0).expand(_SIDE, -1)]
    )
    with torch.no_grad():
        computed = features(image.permute(1, 2, 0))  # type: ignore[operator]
    if not bool(torch.isfinite(computed).all()) or not bool(computed.std() > 0):
        raise AwError(
            f"the features of {name} are not finite or equal everywhere; "
            f"run: {weight_registry.get_command(name, again=True)}"
        )
