"""Pictures of RefineSplat: maps and masks of one step, and T_ent among the scene's instances."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ambiguous_wild.io.files import atomic_path
from ambiguous_wild.io.mask_reasons import MaskReasons, reasons_of
from ambiguous_wild.io.motion_points import MotionPoints
from ambiguous_wild.io.palette import GLOBAL, LOCAL, MASKED, NEUTRAL, faded, plot_colour, ramp, tint
from ambiguous_wild.methods.refinesplat.evidence import ComparisonMaps
from ambiguous_wild.methods.refinesplat.hyperparameters import MaskConfig
from ambiguous_wild.methods.refinesplat.masks import MaskStore, PhotoMasks, enlarge
from ambiguous_wild.splat.step import Step
from ambiguous_wild.vision.motion_maps import POINTS, draw_points


def panels(
    store: MaskStore,
    step: Step,
    photo: np.ndarray,  # [H, W, 3] uint8
    labels: np.ndarray,  # [H, W] int, its instances
    points: MotionPoints | None = None,  # its moving and static features
    *,
    begun: bool = True,
) -> dict[str, np.ndarray]:
    """Return pictures of the evidence, instances by their statistic, and all masks; [H, W, 3] uint8 each.

    The evidence is the statistic of pixels, or the entropy where the method computes it.

    Args:
        store: the masks of all views; nothing is learnt here.
        step: step of a train view at the photo's own size.
        photo, labels, points: what is known of its photo.
        begun: whether masks are used at this step.
    """
    maps, masks = store.examine(step)
    grey = faded(photo)
    local, global_, final, means = (
        t.cpu().numpy() for t in (masks.local, masks.global_, masks.keep < 0.5, masks.means)
    )
    threshold = float(masks.cut.threshold)
    top = 2 * threshold if math.isfinite(threshold) else 1.5 * float(np.nanmax(means, initial=1e-9))
    cut = f"T {threshold:.2f}" if math.isfinite(threshold) else "nothing stands apart"
    of_pixel = np.r_[np.nan, means][np.clip(labels, 0, len(means))]
    shown = maps.statistic if maps.entropy is None else maps.entropy
    evidence = enlarge(shown, labels.shape[0], labels.shape[1]).cpu().numpy()
    name, most = ("evidence", top) if maps.entropy is None else ("entropy", 1.0)
    used = "" if begun else ", not used yet"
    return {
        **({} if points is None else {POINTS: draw_points(photo, points)}),
        f"{name}, mean {evidence.mean():.2f}": ramp(evidence, 0.0, most),
        f"instances, {cut}": _outlined(ramp(of_pixel, 0.0, top), labels),
        f"local {100 * local.mean():.0f} %": tint(grey, local, LOCAL),
        f"global {100 * global_.mean():.0f} %": tint(grey, global_, GLOBAL),
        f"final {100 * final.mean():.0f} %{used}": tint(grey, final, MASKED),
    }


def reasons(store: MaskStore, view: int, maps: ComparisonMaps, masks: PhotoMasks) -> MaskReasons:
    """Return why the regions of a photo are masked or kept.

    A region is the part of an instance, or of what lies in none, for which the same decided; the value in its
    sentence is its mean, and the threshold that of the scene's instances.
    """
    config = store.limited.get(view, store.config.mask)
    labels = store.labels.of_pixel(view).view(store.labels.shapes[view])
    judged, threshold = _judged(store, view, maps, masks), float(masks.cut.threshold)
    structure, fused = config.statistic == "structure", _is_fused(config)
    masked = masks.keep < 0.5
    agrees, differs = f"its {config.statistic} is low", f"its {config.statistic} is high"
    if structure:
        agrees = "it looks as the other photos predict"
        differs = "it differs from what the other photos predict"
    value, weak = "{0:.1f} of {1:.1f}", config.hold * threshold
    limit = "but its instance as a whole does not"
    if fused:
        limit = f"but the mask may cover at most {100 * config.most:.0f} % of this photo"
    sentences = [f"kept: {agrees} ({value})"]
    kinds = torch.zeros_like(labels)

    def add(where: Tensor, sentence: str) -> None:
        kinds[where] = len(sentences)
        sentences.append(sentence)

    if math.isinf(threshold):
        add(~masked, "kept: no region of the scene stands apart from the others")
    add(~masked & (judged > threshold), f"kept: {differs} ({value}), {limit}")
    add(masked, "masked: it fills a gap of a masked region, or lies at its rim")
    if fused:
        near = f"masked: it adjoins what differs more, and is itself above {weak:.1f} ({{0:.1f}})"
        add(masked & (judged > weak), near)
    else:
        add(masked & masks.global_, "masked: it stands out from the rest of the photo")
    add(masked & (judged > threshold), f"masked: {differs} ({value})")
    static, seen = store.labels.static.get(view), store.pixels.seen[view]
    if static is not None:
        add(static & ~masked, "kept: structure from motion shows that its region does not move")
    maskable = store.maskable[view]
    if maskable is not None:
        found = "other parts of this photo were found to move before training, and only those are masked"
        add(~maskable & ~masked, f"kept: {found}")
    if structure and seen is not None:
        add(~seen & ~masked, "kept: too few other photos see this surface")
    for allowed in (maskable, seen if structure else None):
        if allowed is not None:
            add(~allowed & masked, "masked: most of its instance is")
    moving = store.moving[view]
    if moving is not None:
        add(masked & moving, "masked: it moves between neighbouring photos")
    regions = (labels.long().clamp(min=0) * len(sentences) + kinds).cpu().numpy()
    values = judged.double().nan_to_num().cpu().numpy().ravel()
    areas = np.bincount(regions.ravel())
    means = np.bincount(regions.ravel(), values) / np.maximum(areas, 1)
    return reasons_of(
        regions, [sentences[n % len(sentences)].format(mean, threshold) for n, mean in enumerate(means)]
    )


def _is_fused(config: MaskConfig) -> bool:
    return config.combine == "fused" and config.use_local and config.use_global


def _judged(store: MaskStore, view: int, maps: ComparisonMaps, masks: PhotoMasks) -> Tensor:
    """Return what is compared with the threshold at each pixel, [H, W]; see `make_masks`."""
    shape = store.labels.shapes[view]
    own = enlarge(maps.statistic, *shape)
    of_instance = store.labels.on_pixels(view, masks.means.nan_to_num(nan=0.0), shape)
    if not _is_fused(store.config.mask):
        return torch.where(masks.local, of_instance, own.double())
    inside = store.labels.of_pixel(view).view(shape) > 0
    return torch.where(inside, (own * of_instance).clamp(min=0.0).sqrt(), own.double())


def explain(store: MaskStore, step: Step, x: int, y: int) -> list[str]:
    """Return what was measured at a pixel of the photo; empty where nothing measured decided."""
    maps, masks = store.examine(step)
    view, config = step.view, store.limited.get(step.view, store.config.mask)
    moving = store.moving[view]
    if moving is not None and bool(moving[y, x]):
        return []
    shape = store.labels.shapes[view]
    structure, seen = config.statistic == "structure", store.pixels.seen[view]
    if structure and seen is not None and not bool(seen[y, x]):
        return []
    maskable, weight = store.maskable[view], store.factors[view]
    if maskable is not None and not bool(maskable[y, x]):
        return []
    own = float(enlarge(maps.statistic, *shape)[y, x])
    what = "difference in structure, in units of what noise causes" if structure else config.statistic
    lines = [f"evidence of the pixel: {own:.2f} ({what})"]
    if structure and weight is not None:
        lines.append(f"in it, first look at the photos before training: times {float(weight[y, x]):.2f}")
    labels = store.labels.of_pixel(view).view(shape)
    instance = int(labels[y, x])
    if instance > 0:
        mean, pixels = float(masks.means[instance - 1]), int((labels == instance).sum())
        lines.append(f"its instance, {pixels} px: mean evidence {mean:.2f}")
        if _is_fused(config):
            joined = float(_judged(store, view, maps, masks)[y, x])
            lines.append(f"both joined, the root of their product: {joined:.2f}")
    else:
        lines.append("it lies in no instance and is judged alone")
    threshold = float(masks.cut.threshold)
    if math.isfinite(threshold):
        fused = _is_fused(config)
        reach = f"; a region that exceeds it reaches down to {config.hold * threshold:.2f}" if fused else ""
        lines.append(f"threshold of the scene's instances: {threshold:.2f}{reach}")
    local, global_ = ("yes" if bool(mask[y, x]) else "no" for mask in (masks.local, masks.global_))
    lines.append(f"in the local mask: {local}; in the global mask: {global_}")
    return lines


def _outlined(image: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Draw dark lines between instances."""
    edge = np.zeros(labels.shape, bool)
    edge[:, 1:] |= labels[:, 1:] != labels[:, :-1]
    edge[1:] |= labels[1:] != labels[:-1]
    image = image.copy()
    image[edge] = image[edge] // 2
    return image


def draw_entropies(store: MaskStore, folder: Path) -> list[Path]:
    """Write entropies.png: the last statistics of all photos' instances, and their thresholds."""
    judged, shares = store.judged, store.shares
    views = [v for v in sorted(judged) if v in shares and len(judged[v].values)]
    if not views:
        return []
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    values = np.concatenate([judged[v].values for v in views])
    distances = np.concatenate([judged[v].distances for v in views])
    areas = np.concatenate([judged[v].areas for v in views])
    cuts = np.array([shares[v][3] for v in views])
    above = np.concatenate([judged[v].values > shares[v][3] for v in views])
    figure = Figure(figsize=(11, 4.2), layout="constrained", dpi=110)
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    # clip the few largest, which would squeeze all others into one bar
    end = max(float(np.quantile(values, 0.995)), 1.1 * float(cuts[np.isfinite(cuts)].max(initial=0.0)), 1e-6)
    bins = np.linspace(0.0, end, 60)
    clipped = np.minimum(values, end)
    kept, masked = plot_colour(NEUTRAL), plot_colour(MASKED)
    left.hist([clipped[~above], clipped[above]], bins, stacked=True, color=[kept, masked],
              label=[f"below T_ent: {int((~above).sum())}", f"above: {int(above.sum())}"])  # fmt: skip
    left.set_yscale("symlog", linthresh=10)
    left.set_ylabel("instances")
    size = 4 + 60 * np.sqrt(areas / max(float(areas.max()), 1.0))
    # `structure` is itself a distance of photo and render, so its other axis is the area of the instance
    features = store.config.mask.statistic != "structure"
    beside = distances if features else areas
    for chosen, colour in ((~above, kept), (above, masked)):
        right.scatter(clipped[chosen], beside[chosen], size[chosen], color=colour, alpha=0.5, lw=0)
    right.set_yscale("symlog", linthresh=1)
    right.set_ylim(bottom=0)
    right.set_ylabel("distance (units of blur and noise)" if features else "area (px)")
    finite = cuts[np.isfinite(cuts)]
    for axes in (left, right):
        for cut in finite:
            axes.axvline(cut, color="k", lw=0.5, alpha=0.25)
        if len(finite):
            label = f"T_ent, median {np.median(finite):.2f} ({len(finite)} of {len(views)} photos)"
            axes.axvline(float(np.median(finite)), color="k", lw=1.5, label=label)
        axes.set_xlabel(f"mean {store.config.mask.statistic} of an instance (at the end: and above)")
        axes.set_xlim(0, end)
    left.legend(fontsize=8, loc="upper right")
    left.set_title(f"{len(values)} instances of {len(views)} photos, w2 = {store.w2:.2f}", fontsize=10)
    what = "photo against render" if features else "what stands out, and how large it is"
    right.set_title(f"{what}: each instance, its size by its area", fontsize=10)
    path = folder / "entropies.png"
    with atomic_path(path) as temporary:
        figure.savefig(temporary, metadata={"Software": None})
    return [path]
