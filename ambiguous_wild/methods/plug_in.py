"""The paper's plug-in table: RefineSplat's masks, by three thresholds, in methods with appearance."""

from __future__ import annotations

from ambiguous_wild.methods.ablation import Group, Variant


def plug_in(host: str) -> tuple[Group, ...]:
    """The host's group; its default row has the masks that it comes with, or none."""
    grafted = f"{host}@mask=refinesplat"
    return (
        Group(
            "plug-in",
            f"Entropy-aware masks in {host}",
            (
                Variant("m-final", method=grafted, text="masks as RefineSplat makes them here"),
                Variant("t-hard", ("mask.mask.threshold=hard",), "a fixed threshold", method=grafted),
                Variant(
                    "t-statistics", ("mask.mask.threshold=statistics",), "mean and deviation", method=grafted
                ),
                Variant("t-ent", ("mask.mask.threshold=kapur",), "by entropy", method=grafted),
            ),
            "Tab. ablation of the threshold with existing methods",
        ),
    )


GSW = plug_in("gs-w")
WILDGAUSSIANS = plug_in("wildgaussians")
