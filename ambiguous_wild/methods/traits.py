"""What each built-in method consists of, for `aw methods NAME` and `aw methods --table`. Imports no torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Source = Literal["", "code", "code, in part", "summaries"]


@dataclass(frozen=True)
class Traits:
    """A few words on every part; "" = as in 3DGS, or none."""

    masks: str = ""
    appearance: str = ""  # what changes colours by photo; fitted to test photos, or read from them
    density: str = ""
    state: str = ""  # learnt or carried beside the Gaussians of 3DGS
    cpu_only: bool = False  # gsplat does not sum what it needs
    source: Source = ""  # of the facts: the authors' code, only a part of it, or summaries of the paper
    published: str = ""  # features or instances of the release


BUILTIN_TRAITS = {
    "3dgs": Traits(source="code"),
    "3dgs+motion": Traits(masks="features that fit another motion than the place's"),
    "3dgs+truth": Traits(masks="exact"),
    "3dgs-clean": Traits(),
    "refinesplat": Traits(
        "structure of pixels and instances, other views", "", "late; merging; support", "",
        source="summaries", published="DINOv2 ViT-S/14, instances with ids of a video",
    ),
    "refinesplat-paper": Traits(
        "entropy of features, by instance and pixel", "", "late; merging", "net of identities",
        source="summaries", published="DINOv2 ViT-S/14, instances with ids of a video",
    ),
    "refinesplat-printed": Traits(
        "entropy of features, by instance and pixel", "", "late; merging", "net of identities",
        source="summaries", published="DINOv2 ViT-S/14, instances with ids of a video",
    ),
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
        "net on the photo, superpixels", "", "", "transient field, bending and mask nets",
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


def traits_of(name: str) -> Traits | None:
    """Of a built-in method; None for others."""
    return BUILTIN_TRAITS.get(name)
