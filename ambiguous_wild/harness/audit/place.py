"""SSIM and LPIPS that are impossible, exchanged, or unlike the other entries of the table."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from ambiguous_wild.harness.audit.finding import Finding, finding, place_name
from ambiguous_wild.harness.audit.table import Number

# metric family -> what a value can be; LPIPS has no upper limit, but none above 1.5 was ever printed rightly
LIMITS = {"psnr": (2.0, 100.0), "ssim": (-1.0, 1.0), "lpips": (0.0, 1.5)}
MARGIN = 0.5  # of the others' range: how far from them is still among them
OTHERS = 4  # methods a scene needs besides, before one is called unlike them
CLEARLY = 3.0  # times nearer to the others when exchanged
FAR = 8.0  # robust deviations of a residual; in normal noise once in 10^15
USUAL = 4.0  # what the other two metrics may be off
FINEST = 0.0125  # of a spread: nothing below FAR times it is called a misprint
SMALLEST = 4  # methods and scenes a table needs to say what fits
Entry = dict[str, Number]  # family -> number
Scenes = dict[tuple[str, str, str], dict[str, Entry]]  # (table, dataset, scene) -> method -> entry


def out_of_place(numbers: list[Number]) -> list[Finding]:
    """Values outside what the metric allows."""
    found = []
    for n in numbers:
        low, high = LIMITS.get(_family(n), (-np.inf, np.inf))
        if not low <= n.value <= high:
            text = f"{n.method} on {place_name(n)}: {n.metric} {n.text} cannot be ({low:g} to {high:g})"
            found.append(finding("out of place", text, [n]))
    return found


def exchanged(numbers: list[Number]) -> list[Finding]:
    """SSIM and LPIPS exchanged: for one method, or for a whole scene of a table."""
    scenes = _scenes(numbers)
    columns = list(_columns(scenes))
    done = {n for f in columns for n in f.where}
    return columns + [f for place in scenes for f in _cells(scenes, place) if f.where[0] not in done]


def _cells(scenes: Scenes, place: tuple[str, str, str]) -> Iterator[Finding]:
    entries = scenes[place]
    for method, entry in entries.items():
        if _unusual(scenes, place, method) is False:
            continue  # as the method is elsewhere: weak, not exchanged
        others = [e for m, e in entries.items() if m != method]
        if len(others) < OTHERS:
            continue
        psnr, ssim, lpips = (np.array([e[f].value for e in others]) for f in ("psnr", "ssim", "lpips"))
        s, d = entry["ssim"].value, entry["lpips"].value
        usual = float(np.median(ssim)), float(np.median(lpips))
        printed = abs(s - usual[0]) + abs(d - usual[1])
        turned = abs(d - usual[0]) + abs(s - usual[1])
        among = _among(s, ssim) or _among(d, lpips)
        # A method that failed here has a bad PSNR too: then both may be outside rightly.
        worst = psnr.min() - MARGIN * (psnr.max() - psnr.min())
        if not among and CLEARLY * turned < printed and entry["psnr"].value >= worst:
            text = (
                f"{method} on {place_name(entry['ssim'])}: SSIM {entry['ssim'].text} and LPIPS "
                f"{entry['lpips'].text} look exchanged (others: SSIM {ssim.min():g} to {ssim.max():g}, LPIPS "
                f"{lpips.min():g} to {lpips.max():g})"
            )
            yield finding("swapped", text, (entry["ssim"], entry["lpips"]))


def _unusual(scenes: Scenes, place: tuple[str, str, str], method: str) -> bool | None:
    """Whether SSIM and LPIPS, exchanged, are nearer to the method's elsewhere; None: it is nowhere else."""
    rest = [e[method] for p, e in scenes.items() if p != place and method in e]
    if not rest:
        return None
    ssim, lpips = (float(np.median([e[f].value for e in rest])) for f in ("ssim", "lpips"))
    s, d = (scenes[place][method][f].value for f in ("ssim", "lpips"))
    return abs(s - ssim) + abs(d - lpips) > abs(d - ssim) + abs(s - lpips)


def _columns(scenes: Scenes) -> Iterator[Finding]:
    from scipy.stats import spearmanr

    for place, entries in scenes.items():
        if len(entries) < OTHERS:
            continue
        votes = [v for m in entries if (v := _unusual(scenes, place, m)) is not None]
        if len(votes) < OTHERS or not all(votes):
            continue
        psnr, ssim, lpips = ([e[f].value for e in entries.values()] for f in ("psnr", "ssim", "lpips"))
        if len(set(psnr)) > 1 and spearmanr(psnr, ssim)[0] < spearmanr(psnr, lpips)[0]:
            involved = [e[f] for e in entries.values() for f in ("ssim", "lpips")]
            text = f"SSIM and LPIPS of {place_name(involved[0])} in {place[0]} look exchanged for all methods"
            yield finding("swapped", text, involved)


def unlike(numbers: list[Number]) -> list[Finding]:
    """SSIM or LPIPS far from what method and scene together let expect, where PSNR and the other are not.

    A method that failed on a scene is bad in all three: that is a result, not a misprint.
    """
    known = {n for f in exchanged(numbers) for n in f.where}
    grids: dict[str, dict[tuple[str, str], Entry]] = defaultdict(dict)
    for (_, dataset, scene), entries in _scenes(numbers).items():
        for method, entry in entries.items():
            grids[dataset].setdefault((method, scene), entry)
    found = []
    for grid in grids.values():
        rests = {family: _residuals(grid, family) for family in LIMITS}
        for key, entry in grid.items():
            far = {family: abs(rest[key][0]) for family, rest in rests.items() if key in rest}
            for family in ("ssim", "lpips"):
                others = [v for f, v in far.items() if f != family]
                n = entry[family]
                if far and far[family] > FAR and max(others) < USUAL and n.where not in known:
                    fits = rests[family][key][1]
                    text = f"{n.method} on {place_name(n)}: {family.upper()} {n.text}, {fits:.2f} would fit"
                    found.append(finding("out of place", text, [n]))
    return found


def _residuals(grid: dict[tuple[str, str], Entry], family: str) -> dict[tuple[str, str], tuple[float, float]]:
    """(residual in robust deviations, expected value) by method and scene; empty for a small table."""
    methods, scenes = (sorted({key[i] for key in grid}) for i in (0, 1))
    table = np.full((len(methods), len(scenes)), np.nan)
    for (method, scene), entry in grid.items():
        table[methods.index(method), scenes.index(scene)] = entry[family].value
    if min(table.shape) < SMALLEST or np.isnan(table).mean() > 0.5:
        return {}
    fit = np.zeros_like(table)
    for _ in range(10):  # Tukey's median polish
        fit += np.nanmedian(table - fit, axis=1, keepdims=True)
        fit += np.nanmedian(table - fit, axis=0, keepdims=True)
    rest = table - fit
    # The mean, not the median: many residuals of a polished table are zero by construction. The largest is
    # left out, or it would hide itself.
    spread = 1.2533 * np.mean(np.sort(np.abs(rest[~np.isnan(rest)]))[:-1])
    # What the fit takes up: a row and a column of freedom; and three digits are never known better than this.
    typical = max(spread * np.sqrt(table.size / ((len(methods) - 1) * (len(scenes) - 1))), FINEST)
    return {
        (m, s): (float(rest[i, j] / typical), float(fit[i, j]))
        for i, m in enumerate(methods)
        for j, s in enumerate(scenes)
        if not np.isnan(rest[i, j])
    }


def _scenes(numbers: list[Number]) -> Scenes:
    """PSNR, SSIM and LPIPS of every method on every scene, where all three are."""
    found: dict[tuple[str, str, str], dict[str, Entry]] = defaultdict(lambda: defaultdict(dict))
    for n in numbers:
        if n.known and not n.setting and _family(n) in LIMITS:
            found[n.table, n.dataset, n.scene][n.method].setdefault(_family(n), n)
    return {k: {m: e for m, e in v.items() if len(e) == len(LIMITS)} for k, v in found.items()}


def _family(n: Number) -> str:
    return n.metric.partition("_")[0]


def _among(value: float, others: np.ndarray) -> bool:
    low, high = others.min(), others.max()
    return bool(low - MARGIN * (high - low) <= value <= high + MARGIN * (high - low))
