"""Pictures of RefineSplat: maps and masks of one step, and T_ent among the scene's instances."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from ambiguous_wild.io.files import atomic_path
from ambiguous_wild.io.motion_points import MotionPoints
from ambiguous_wild.io.palette import GLOBAL, LOCAL, MASKED, NEUTRAL, faded, plot_colour, ramp, tint
from ambiguous_wild.methods.refinesplat.masks import MaskStore, enlarge
from ambiguous_wild.splat.step import Step
from ambiguous_wild.vision.motion_maps import POINTS, draw_points


def panels(
    store: MaskStore,
    step: Step,
    photo: np.ndarray,  # [H, W, 3] uint8
    labels: np.ndarray,  # [H, W] int32, its instances
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


def explain(store: MaskStore, step: Step, x: int, y: int) -> list[str]:
    """Return what decided about a pixel of the photo, in the order in which it is asked."""
    maps, masks = store.examine(step)
    view, config = step.view, store.config.mask
    shape = store.labels.shapes[view]
    structure, seen = config.statistic == "structure", store.pixels.seen[view]
    static = store.labels.static.get(view)
    if structure and seen is not None and not bool(seen[y, x]):
        return ["too few other photos see this surface: never masked"]
    if view in store.maskable and not bool(store.maskable[view][y, x]):
        return ["first look at the photos before training: a crowd, but not this pixel; never masked"]
    own = float(enlarge(maps.statistic, *shape)[y, x])
    what = "difference in structure, in units of what noise causes" if structure else config.statistic
    lines = [f"evidence of the pixel: {own:.2f} ({what})"]
    if structure and view in store.factors:
        factor = float(store.factors[view][y, x])
        lines.append(f"in it, first look at the photos before training: times {factor:.2f}")
    labels = store.labels.of_pixel[view].view(shape)
    instance, joined = int(labels[y, x]), own
    fused = config.combine == "fused" and config.use_local and config.use_global
    if instance > 0:
        mean, pixels = float(masks.means[instance - 1]), int((labels == instance).sum())
        lines.append(f"its instance, {pixels} px: mean evidence {mean:.2f}")
        if fused:
            joined = math.sqrt(max(own, 0.0) * max(mean, 0.0))
            lines.append(f"both joined, the root of their product: {joined:.2f}")
    else:
        lines.append("it lies in no instance and is judged alone")
    threshold = float(masks.cut.threshold)
    if math.isfinite(threshold):
        reach = f"; a region that exceeds it reaches down to {config.hold * threshold:.2f}" if fused else ""
        lines.append(f"threshold of the scene's instances: {threshold:.2f}{reach}")
    else:
        lines.append("no instance of the scene stands apart from the others")
    if static is not None and bool(static[y, x]):
        return [*lines, "structure from motion shows that its instance is static: never masked"]
    local, global_ = ("yes" if bool(mask[y, x]) else "no" for mask in (masks.local, masks.global_))
    lines.append(f"in the local mask: {local}; in the global mask: {global_}")
    masked = bool(masks.keep[y, x] < 0.5)
    if fused and not masked and joined > threshold:
        most = store.limited.get(view, config).most
        lines.append(f"the mask may cover {100 * most:.0f} % of the photo: only its surest pixels stay")
    if fused and masked and joined <= config.hold * threshold:
        lines.append("it lies in a gap or at the rim of a mask, which is filled and grown")
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
