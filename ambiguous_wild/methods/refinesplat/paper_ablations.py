"""The tables of the paper as ablations of `refinesplat-paper`. Settings are on top of its defaults."""

from __future__ import annotations

from ambiguous_wild.methods.ablation import Group, Variant

NAME = "refinesplat-paper"
_NO_MASKS = ("mask.use_local=false", "mask.use_global=false")
_NO_ENTROPY = ("density.decides=photometric", "density.clone_shift=0")
_NO_MERGING = ("density.merge_every=0",)
_NO_EDC = (*_NO_ENTROPY, *_NO_MERGING)
_NO_CR = ("lambda_cr=0",)
# the paper states no value of T_hard; these are the middle of H's range, and ten times U / H of a sure match
_T_HARD = ("mask.threshold=hard", "mask.hard=0.5")
_T_GLOBAL_HARD = ("mask.spread=hard", "mask.global_hard=10")
_THRESHOLDS = (
    ("t-hard", (*_T_HARD, *_T_GLOBAL_HARD), "T_hard: fixed values"),
    ("t-statistics", ("mask.threshold=statistics",), "T_statistics: mean and deviation"),
    ("t-ent", ("mask.threshold=kapur",), "T_ent"),
)


def _plugged(host: str) -> tuple[Variant, ...]:
    """Return a row of the host itself, and rows with the paper's masks under each threshold."""
    return (
        Variant(host, method=host, text="its own masks"),
        *(
            Variant(f"{host}-{name}", settings, text, method=f"{host}@mask={NAME}")
            for name, settings, text in _THRESHOLDS
        ),
    )


ABLATIONS = (
    Group(
        "modules",
        "Entropy-aware masks (EAM), density control (EDC), consistency (CR)",
        (
            Variant("robustsplat", method="robustsplat", text="the paper's baseline row"),
            Variant("eam", (*_NO_EDC, *_NO_CR), "(a)"),
            Variant("eam-cr", _NO_EDC, "(b)"),
            Variant("eam-edc", _NO_CR, "(c)"),
            Variant("eam-edc-cr", ("lambda_cr=0.2",), "(d)"),
            Variant("no-losses", ("lambda_id=0", "lambda_cr=0"), "neither L_id nor L_cr; not in the paper"),
        ),
        "Tab. impact of each module",
    ),
    Group(
        "masks",
        "Local and global mask",
        (
            Variant("robustsplat", method="robustsplat", text="(a) the paper's baseline row"),
            Variant("neither", _NO_MASKS, "no masks; not in the paper"),
            Variant("local", ("mask.use_global=false",), "(b) M_local alone"),
            Variant("global", ("mask.use_local=false",), "(c) M_global alone"),
            Variant("union", ("mask.combine=union",), "(d)"),
        ),
        "Tab. ablation of the entropy-aware adaptive masking",
    ),
    Group(
        "thresholds",
        "Threshold between static and transient instances",
        (
            Variant("t-hard", _T_HARD, "T_hard: a fixed value"),
            *(Variant(name, settings, text) for name, settings, text in _THRESHOLDS[1:]),
            Variant("t-ent-literal", ("mask.threshold=literal",), "T_ent as printed"),
        ),
        "Fig. effectiveness of transient masks and thresholds",
    ),
    Group(
        "global-threshold",
        "Threshold of the global mask",
        (
            Variant("t-hard", _T_GLOBAL_HARD, "T_hard: a fixed value"),
            Variant("t-glb", ("mask.spread=std",), "T_glb with the standard deviation"),
            Variant("t-glb-literal", ("mask.spread=var",), "T_glb as printed, with the variance"),
        ),
        "Tab. impact of the entropy-aware adaptive global threshold",
    ),
    Group(
        "plug-in",
        "The masks in other methods",
        (*_plugged("gs-w"), *_plugged("wildgaussians")),
        "Tab. ablation of the threshold with existing methods",
    ),
    Group(
        "density",
        "Entropy and merging in density control",
        (
            Variant("robustsplat", method="robustsplat", text="(a) the paper's baseline row"),
            Variant("neither", _NO_EDC, "neither; not in the paper"),
            Variant("entropy", _NO_MERGING, "(b)"),
            Variant("merging", _NO_ENTROPY, "(c)"),
            Variant("both", ("density.decides=total",), "(d)"),
        ),
        "Tab. analysis of the entropy-aware density control",
    ),
    Group(
        "density-control",
        "Density control of other papers in the place of EDC",
        (
            Variant("pup", method=f"{NAME}@density=pup-3dgs", text="PUP 3D-GS"),
            Variant("uad", method=f"{NAME}@density=uad", text="UAD of ForestSplats"),
            Variant("edc", ("density.decides=total",), "EDC"),
        ),
        "Tab. comparison of the density control strategy",
    ),
    Group(
        "alpha1",
        "alpha_1, the weight of consistency",
        tuple(Variant(f"alpha1-{value}", (f"lambda_cr={value}",)) for value in ("0.1", "0.2", "0.3")),
        "Tab. sensitivity analysis for alpha_1",
    ),
    Group(
        "features",
        "Patch size and variant of DINO",
        tuple(
            Variant(name, (f"features={name}",), text, features=name)
            for name, text in (
                ("dinov2-small", "14 x 14 patches, the paper's"),
                ("dino-vits16", "16 x 16 patches, DINOv1"),
                ("labhog", "hand-made"),
                ("sceneconv", "trained on the scene"),
            )
        ),
        "Tab. sensitivity of size, sensitivity of DINO",
    ),
    Group(
        "dilation",
        "Dilation (px)",
        tuple(Variant(f"dilation-{size}", (f"mask.dilation={size}",)) for size in (3, 5, 7)),
        "Tab. sensitivity of filters",
    ),
    Group(
        "merge-threshold",
        "Largest colour distance of Gaussians that merge",
        tuple(
            Variant(f"colour-{value}", (f"density.merge.colour={value}",))
            for value in ("0.10", "0.15", "0.20")
        ),
        "Tab. threshold of EDC",
    ),
    Group(
        "repairs",
        "Each printed form in the place of the repair",
        (
            Variant("t-ent-literal", ("mask.threshold=literal",), "additive objective"),
            Variant("spread-var", ("mask.spread=var",), "variance"),
            Variant("overlap-literal", ("density.merge.form=literal",), "a density, not a share"),
            Variant("id-everywhere", ("weigh_id=false",), "L_id asks for the distractor too"),
            Variant("entropy-unlimited", ("entropy_limit=0",), "L_id and L_cr outweigh the photo"),
            Variant("nothing-limited", ("mask.most=1",), "a photo may be masked whole"),
            Variant("all", method="refinesplat-printed", text="as printed"),
        ),
    ),
)
