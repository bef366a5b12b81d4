"""The paper's ablations of RefineSplat, and ours, as data. Settings are on top of the defaults.

If the paper varies a loss that is off by default (see config.py), the rows switch it on.
"""

from __future__ import annotations

from ambiguous_wild.methods.ablation import Group, Variant

_NO_MASKS = ("mask.use_local=false", "mask.use_global=false", "first_look.on=false")
_NO_SUPPORT = ("density.support.least_share=0",)
_PLAIN_DENSITY = (
    "density.decides=photometric", "density.clone_shift=0", "density.merge_every=0", *_NO_SUPPORT,
)  # fmt: skip
_CR = ("lambda_cr=0.2",)
_PRINTED_LOSSES = ("lambda_id=1", "lambda_cr=0.2")
_NO_GATE = ("mask.gate=0", "mask.least=0")
_LITERAL = ("mask.threshold=literal", *_NO_GATE, "mask.ceiling=0")
_NO_AGREEMENT = ("mask.disagree=0", "mask.disagree_units=0")
_NO_GLOBAL_GATE = ("mask.global_gate=0", "mask.global_units=0")
# instances judged on the feature grid and united with the global mask, as the paper does
_ON_FEATURES = ("mask.statistic=evidence", "mask.combine=union", "mask.static_tracks=0.35", "mask.dilation=5")
_NO_TRACKS = (*_ON_FEATURES[:2], "mask.static_tracks=0", _ON_FEATURES[3])
OTHER_DENSITY = tuple(
    Variant(name, method=f"refinesplat@density={donor}", text=text)
    for name, donor, text in (
        ("pup", "pup-3dgs", "PUP 3D-GS decides who goes"),
        ("uad", "uad", "ForestSplats' uncertainty-aware density"),
    )
)

ABLATIONS = (
    Group(
        "modules",
        "Entropy-aware masks (EAM), density control (EDC), consistency (CR)",
        (
            Variant("robustsplat", method="robustsplat", text="the paper's baseline row"),
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
            Variant("local", ("mask.use_global=false",), "(b) M_local alone"),
            Variant("global", ("mask.use_local=false",), "(c) M_global alone"),
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
            Variant("t-statistics", ("mask.threshold=statistics",), "T_statistics: mean and deviation"),
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
            Variant("entropy", ("density.merge_every=0", *_NO_SUPPORT), "(b) entropy, no merging"),
            Variant(
                "merging",
                ("density.decides=photometric", "density.clone_shift=0", *_NO_SUPPORT),
                "(c) merging alone",
            ),
            Variant("both", _NO_SUPPORT, "(d)"),
            Variant("support", ("density.decides=total",), "and Gaussians masked in every photo are removed"),
            *OTHER_DENSITY,
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
        (
            Variant("pup", method="refinesplat@density=pup-3dgs", text="(a)"),
            Variant(
                "uad", method="refinesplat@density=uad", text="(b); a reading: its formula is unverified"
            ),
        ),
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
            *(
                Variant(f"strength-{value}", (f"mask.multiview.strength={value}",))
                for value in ("0.5", "1", "3")
            ),
            *(Variant(f"views-{value}", (f"mask.multiview.views={value}",)) for value in ("4", "16")),
            Variant("any-photo", ("mask.multiview.agree=0",), "views of any colour are used"),
            Variant("no-ceiling", ("mask.ceiling=0",), "no upper limit of thresholds"),
            Variant("low-ceiling", ("mask.ceiling_least=0",), "no lower limit of the ceiling"),
            Variant("no-sparse-points", ("mask.multiview.sparse=false",), "unlearnt surfaces have no depth"),
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
            *(Variant(f"dilation-{size}", (f"mask.dilation={size}",)) for size in (3, 5, 7)),
        ),
        "Tab. sensitivity of filters",
    ),
    Group(
        "alpha1",
        "alpha_1, the weight of consistency",
        tuple(Variant(f"alpha1-{value}", (f"lambda_cr={value}",)) for value in ("0", "0.1", "0.2", "0.3")),
        "Tab. sensitivity analysis for alpha_1",
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
            Variant(
                "no-tracks",
                _NO_TRACKS,
                "SfM tracks keep no instance",
            ),
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
