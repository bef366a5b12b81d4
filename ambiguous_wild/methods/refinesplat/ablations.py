"""The paper's ablations of RefineSplat, and ours, as data. Settings are on top of the defaults.

If the paper varies a loss that is off by default (see hyperparameters.py), the rows switch it on.
"""

from __future__ import annotations

from dataclasses import replace

from ambiguous_wild.methods.ablation_groups import Group, Variant, values

_NEITHER_MASK = ("mask.use_local=false", "mask.use_global=false")
_NO_MASKS = (*_NEITHER_MASK, "first_look.on=false")
_NO_SUPPORT = ("density.support.least_share=0",)
_NO_ENTROPY = ("density.decides=photometric", "density.clone_shift=0")
_NO_MERGING = ("density.merge_every=0",)
_NO_EDC = (*_NO_ENTROPY, *_NO_MERGING)
_PLAIN_DENSITY = (*_NO_EDC, *_NO_SUPPORT)
_CR = ("lambda_cr=0.2",)
_PRINTED_LOSSES = ("lambda_id=1", "lambda_cr=0.2")
_NO_GATE = ("mask.gate=0", "mask.least=0")
_LITERAL = ("mask.threshold=literal", *_NO_GATE, "mask.ceiling=0")
_NO_AGREEMENT = ("mask.disagree=0", "mask.disagree_units=0")
_NO_GLOBAL_GATE = ("mask.global_gate=0", "mask.global_units=0")
# instances judged on the feature grid and united with the global mask, as the paper does
_ON_FEATURES = ("mask.statistic=evidence", "mask.combine=union", "mask.static_tracks=0.35", "mask.dilation=5")
_NO_TRACKS = (*_ON_FEATURES[:2], "mask.static_tracks=0", _ON_FEATURES[3])

# rows and tables that `refinesplat-paper` has too
_BASELINE = Variant("robustsplat", method="robustsplat", text="the paper's baseline row")
_ONE_MASK = (
    Variant("local", ("mask.use_global=false",), "(b) M_local alone"),
    Variant("global", ("mask.use_local=false",), "(c) M_global alone"),
)
_STATISTICS = Variant("t-statistics", ("mask.threshold=statistics",), "T_statistics: mean and deviation")
_OTHER_DENSITY = (
    Variant("pup", method="refinesplat@density=pup-3dgs", text="(a)"),
    Variant("uad", method="refinesplat@density=uad", text="(b); a reading: its formula is unverified"),
)
_ALPHA1 = values("alpha1", "lambda_cr", 0.1, 0.2, 0.3)
_DILATIONS = values("dilation", "mask.dilation", 3, 5, 7)
_MERGE_THRESHOLD = Group(
    "merge-threshold",
    "Largest colour distance of Gaussians that merge",
    values("colour", "density.merge.colour", "0.10", "0.15", "0.20"),
    "Tab. threshold of EDC",
)

ABLATIONS = (
    Group(
        "modules",
        "Entropy-aware masks (EAM), density control (EDC), consistency (CR)",
        (
            _BASELINE,
            Variant("none", (*_NO_MASKS, *_PLAIN_DENSITY, "lambda_cr=0"), "none of the three"),
            Variant("eam", (*_PLAIN_DENSITY, "lambda_cr=0"), "(a) masks alone"),
            Variant("eam-cr", (*_PLAIN_DENSITY, *_CR), "(b) masks and consistency"),
            Variant("eam-edc", ("lambda_cr=0",), "(c) masks and density control"),
            Variant("eam-edc-cr", _CR, "(d) all three"),
            Variant("edc", (*_NO_MASKS, "lambda_cr=0"), "density control alone; not in the paper"),
        ),
        "Tab. impact of each module",
    ),
    Group(
        "masks",
        "Local and global mask",
        (
            Variant("neither", _NO_MASKS),
            *_ONE_MASK,
            Variant("union", ("mask.combine=union",), "(d) as printed"),
            Variant("fused", ("mask.combine=fused",), "geometric mean of pixel and instance"),
        ),
        "Tab. ablation of the entropy-aware adaptive masking",
    ),
    Group(
        "thresholds",
        "Threshold between static and transient instances",
        (
            Variant("t-hard", ("mask.threshold=hard",), "T_hard: a fixed value"),
            _STATISTICS,
            Variant("t-ent", ("mask.threshold=kapur",), "T_ent"),
            Variant("t-ent-literal", _LITERAL, "T_ent as printed: no gate, floor or ceiling"),
            Variant("t-ent-no-gate", ("mask.threshold=kapur", *_NO_GATE), "T_ent that always cuts"),
        ),
        "Tab. ablation of the threshold with existing methods",
    ),
    Group(
        "density",
        "Entropy and merging in density control",
        (
            Variant("neither", _PLAIN_DENSITY, "(a)"),
            Variant("entropy", (*_NO_MERGING, *_NO_SUPPORT), "(b) entropy, no merging"),
            Variant("merging", (*_NO_ENTROPY, *_NO_SUPPORT), "(c) merging alone"),
            Variant("both", _NO_SUPPORT, "(d)"),
            Variant("support", ("density.decides=total",), "and Gaussians masked in every photo are removed"),
            *_OTHER_DENSITY,
            # these rows switch the entropy terms on, without which `decides` has no effect
            Variant(
                "losses-total", (*_PRINTED_LOSSES, "density.decides=total"), "with L_id, L_cr: L decides"
            ),
            Variant("losses-photometric", (*_PRINTED_LOSSES, "density.decides=photometric"), "L_GS decides"),
            Variant(
                "losses-entropy", (*_PRINTED_LOSSES, "density.decides=entropy"), "the entropy terms decide"
            ),
        ),
        "Tab. analysis of the entropy-aware density control, comparison of the density control strategy",
    ),
    Group(
        "density-control",
        "Density control of others in its place (PUP, UAD); the default is EDC",
        _OTHER_DENSITY,
        "Tab. comparison of the density control strategy",
    ),
    Group(
        "evidence",
        "What is judged, and the use of other views and visits",
        (
            Variant("structure", ("mask.statistic=structure",), "colour and structure of pixels"),
            Variant(
                "no-other-views",
                ("mask.multiview.strength=0", "mask.multiview.seen_by=0"),
                "each view by itself",
            ),
            *values("strength", "mask.multiview.strength", 0.5, 1, 3),
            *values("views", "mask.multiview.views", 4, 16),
            Variant("any-photo", ("mask.multiview.agree=0",), "views of any colour are used"),
            Variant("no-ceiling", ("mask.ceiling=0",), "no upper limit of thresholds"),
            Variant("low-ceiling", ("mask.ceiling_least=0",), "no lower limit of the ceiling"),
            Variant("no-sparse-points", ("mask.multiview.sparse=false",), "unlearnt surfaces have no depth"),
            Variant(
                "unconfirmed",
                ("mask.multiview.unconfirmed=1",),
                "full evidence where no other photo shows what the render shows",
            ),
            Variant("rims", ("mask.multiview.seen_by=0",), "masks where no other photo looks"),
            Variant("no-first-look", ("first_look.on=false",), "no masks before the first renders"),
            Variant("first-look-once", ("first_look.rounds=0",), "not asked again"),
            Variant("first-look-rough", ("first_look.smooth=0",), "not smoothed"),
            Variant("unbounded", ("first_look.most=0",), "masks of any size, whatever the first look masks"),
            Variant("calm-crowd", ("first_look.crowd_weight=1.5",), "a crowd weighs as elsewhere"),
            Variant(
                "first-look-first",
                ("first_look.weight=1", "first_look.crowd_weight=1"),
                "not used in later masks",
            ),
            Variant("no-motion", ("first_look.motion=0",), "features that move or stay are not asked"),
            Variant("no-memory", ("mask.memory=0",), "the current render only"),
            Variant("no-hold", ("mask.hold=1",), "regions do not grow below the threshold"),
            Variant("identities", ("mask.entropy_weight=0.5",), "scaled by the contrast of identities"),
            Variant("on-features", _ON_FEATURES, "identities and features on their grid"),
        ),
    ),
    Group(
        "filters",
        "Box filter over U / H (cells) and dilation (px)",
        (
            Variant("no-box", (*_ON_FEATURES, "mask.box=1")),
            *(Variant(f"box-{size}", (*_ON_FEATURES, f"mask.box={size}")) for size in (3, 5, 7)),
            Variant("no-dilation", ("mask.dilation=1",)),
            *_DILATIONS,
        ),
        "Tab. sensitivity of filters",
    ),
    Group(
        "alpha1",
        "alpha_1, the weight of consistency",
        (*values("alpha1", "lambda_cr", 0), *_ALPHA1),
        "Tab. sensitivity analysis for alpha_1",
    ),
    _MERGE_THRESHOLD,
    Group(
        "features",
        "Features that compare photo and render",
        tuple(
            Variant(name, (*_ON_FEATURES, f"features={name}"), features=name, text=text)
            for name, text in (
                ("labhog", "weight-free: colours and edges"),
                ("sceneconv", "weight-free: trained on the scene"),
                ("dinov2-small", "14 x 14 patches, the paper's"),
                ("dino-vits16", "16 x 16 patches, DINOv1"),
                ("dino-vits8", "8 x 8 patches, DINOv1"),
            )
        ),
        "Tab. sensitivity of size, sensitivity of DINO",
    ),
    Group(
        "w2",
        "Weight of T_ent's lower subset",
        (Variant("learnt", ("mask.w2=none",)), Variant("fixed-0.5", ("mask.w2=0.5",))),
    ),
    Group(
        "printed",
        "Each printed form in the place of ours",
        (
            Variant("on-features", _ON_FEATURES, "reference of the rows on features"),
            Variant("sigmoid", (*_ON_FEATURES, "mask.variant=sigmoid"), "psi one-against-rest"),
            Variant(
                "statistic-entropy", ("mask.statistic=entropy", *_ON_FEATURES[1:]), "entropy of the render"
            ),
            Variant("union", ("mask.combine=union",), "local or global"),
            Variant("scope-photo", ("mask.scope=photo",), "each photo cut by itself"),
            Variant("t-ent-literal", _LITERAL, "additive objective, no gate, floor or ceiling"),
            Variant("no-gate", _NO_GATE, "always cuts in two"),
            Variant("no-agreement", (*_ON_FEATURES, *_NO_AGREEMENT), "an uncertain identity is enough"),
            Variant("no-tracks", _NO_TRACKS, "SfM tracks keep no instance"),
            Variant("no-alpha", ("mask.least_alpha=0",), "unlearnt pixels are judged too"),
            Variant("cosine-plain", (*_ON_FEATURES, "mask.cosine=plain")),
            Variant("spread-var", (*_ON_FEATURES, "mask.spread=var"), "mean + variance"),
            Variant("no-global-gate", (*_ON_FEATURES, *_NO_GLOBAL_GATE)),
            Variant("overlap-literal", ("density.merge.form=literal",), "a density, not a share"),
            Variant("no-support", _NO_SUPPORT, "Gaussians masked in every photo stay"),
            Variant("whole-components", ("density.merge.most=0",), "clusters of any size merge"),
            Variant("losses", _PRINTED_LOSSES, "L_id + 0.2 L_cr"),
            Variant("all", method="refinesplat-printed", text="all of them together"),
        ),
    ),
)


# the tables of the paper as ablations of `refinesplat-paper`, on top of its defaults
PAPER = "refinesplat-paper"
_NO_CR = ("lambda_cr=0",)
# the paper states no value of T_hard; these are the middle of H's range, and ten times U / H of a sure match
_T_HARD = ("mask.threshold=hard", "mask.hard=0.5")
_T_GLOBAL_HARD = ("mask.spread=hard", "mask.global_hard=10")
_THRESHOLDS = (
    Variant("t-hard", (*_T_HARD, *_T_GLOBAL_HARD), "T_hard: fixed values"),
    _STATISTICS,
    Variant("t-ent", ("mask.threshold=kapur",), "T_ent"),
)


def _plugged(host: str) -> tuple[Variant, ...]:
    """Return a row of the host itself, and rows with the paper's masks under each threshold."""
    return (
        Variant(host, method=host, text="its own masks"),
        *(replace(t, name=f"{host}-{t.name}", method=f"{host}@mask={PAPER}") for t in _THRESHOLDS),
    )


PAPER_ABLATIONS = (
    Group(
        "modules",
        "Entropy-aware masks (EAM), density control (EDC), consistency (CR)",
        (
            _BASELINE,
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
            replace(_BASELINE, text=f"(a) {_BASELINE.text}"),
            Variant("neither", _NEITHER_MASK, "no masks; not in the paper"),
            *_ONE_MASK,
            Variant("union", ("mask.combine=union",), "(d)"),
        ),
        "Tab. ablation of the entropy-aware adaptive masking",
    ),
    Group(
        "thresholds",
        "Threshold between static and transient instances",
        (
            Variant("t-hard", _T_HARD, "T_hard: a fixed value"),
            *_THRESHOLDS[1:],
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
            replace(_BASELINE, text=f"(a) {_BASELINE.text}"),
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
            Variant("pup", method=f"{PAPER}@density=pup-3dgs", text="PUP 3D-GS"),
            Variant("uad", method=f"{PAPER}@density=uad", text="UAD of ForestSplats"),
            Variant("edc", ("density.decides=total",), "EDC"),
        ),
        "Tab. comparison of the density control strategy",
    ),
    Group(
        "alpha1",
        "alpha_1, the weight of consistency",
        _ALPHA1,
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
        _DILATIONS,
        "Tab. sensitivity of filters",
    ),
    _MERGE_THRESHOLD,
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
