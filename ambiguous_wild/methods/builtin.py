"""The methods of the package, with recipes as names: listing them imports none of their code."""

from __future__ import annotations

from ambiguous_wild.methods.entry import MethodEntry

PAPER_NETWORKS = "DINOv2 and SAM 2; without their weights efficientnet-lite0; else labhog and graph"

BUILTIN = (
    MethodEntry(
        name="3dgs",
        summary="plain 3D Gaussian Splatting: treats all pixels as static",
        recipe="ambiguous_wild.methods.threedgs:build",
        paper="Kerbl et al., SIGGRAPH 2023",
    ),
    MethodEntry(
        name="refinesplat",
        summary="for ambiguous distractors, without pretrained weights: RefineSplat's parts, and ours where "
        "the paper's measure worse (structure and other views instead of entropy)",
        recipe="ambiguous_wild.methods.refinesplat.recipe:build",
        paper="Rectifying Mask via Entropy for Distractor-Free 3DGS in Ambiguous Scenarios",
        ablations="ambiguous_wild.methods.refinesplat.ablations:ABLATIONS",
        note="weight-free; ours where the paper's parts measure worse (docs/fidelity.md)",
    ),
    MethodEntry(
        name="refinesplat-paper",
        summary="RefineSplat with all parts of its paper: identities, entropy masks, L_id and L_cr, "
        "entropy-aware density, merging; repaired only where the print degenerates",
        recipe="ambiguous_wild.methods.refinesplat.recipe:build",
        config="ambiguous_wild.methods.refinesplat.paper:PaperConfig",
        paper="Rectifying Mask via Entropy for Distractor-Free 3DGS in Ambiguous Scenarios",
        needs=PAPER_NETWORKS,
        ablations="ambiguous_wild.methods.refinesplat.ablations:PAPER_ABLATIONS",
        note="all parts of the paper, repaired where the print degenerates (docs/fidelity.md); features "
        "{features}, instances {instances}",
    ),
    MethodEntry(
        name="refinesplat-printed",
        summary="RefineSplat as its paper prints it, except two formulas with errors",
        recipe="ambiguous_wild.methods.refinesplat.recipe:build",
        config="ambiguous_wild.methods.refinesplat.paper:PrintedConfig",
        paper="Rectifying Mask via Entropy for Distractor-Free 3DGS in Ambiguous Scenarios",
        needs=PAPER_NETWORKS,
        note="as printed, except two formulas with errors (docs/fidelity.md); features {features}, "
        "instances {instances}",
    ),
    MethodEntry(
        name="robustsplat",
        summary="densification delayed until masks are stable; a net on frozen features, "
        "taught coarse to fine",
        recipe="ambiguous_wild.methods.robustsplat:build",
        paper="Fu et al., ICCV 2025 (arXiv 2506.02751)",
        note="features {features}",
    ),
    MethodEntry(
        name="dronesplat",
        summary="masks instances whose residual is high for their photo",
        recipe="ambiguous_wild.methods.dronesplat:build",
        paper="Tang et al., CVPR 2025 (arXiv 2503.16964)",
        note="instances {instances}",
    ),
    MethodEntry(
        name="wildgaussians",
        summary="masks by an uncertainty learnt from features; embeddings change colours",
        recipe="ambiguous_wild.methods.wildgaussians:build",
        ablations="ambiguous_wild.methods.ablation_groups:WILDGAUSSIANS",
        paper="Kulhanek et al., NeurIPS 2024 (arXiv 2407.08447)",
        note="features {features}",
    ),
    MethodEntry(
        name="absgs",
        summary="large blurred Gaussians split by the absolute screen gradient",
        recipe="ambiguous_wild.methods.absgs:build",
        paper="AbsGS, 2024",
    ),
    MethodEntry(
        name="mcmc",
        summary="a fixed number of Gaussians: dead ones move onto live ones, noise explores",
        recipe="ambiguous_wild.methods.mcmc:build",
        paper="3DGS-MCMC",
    ),
    MethodEntry(
        name="pup-3dgs",
        summary="after growth, removes the Gaussians that pictures depend on least, then refines",
        recipe="ambiguous_wild.methods.pup:build",
        paper="PUP 3D-GS, CVPR 2025",
    ),
    MethodEntry(
        name="desplat",
        summary="per-image Gaussians in front of the camera model the transients",
        recipe="ambiguous_wild.methods.desplat:build",
        paper="DeSplat, CVPR 2025 (arXiv 2411.19756)",
    ),
    MethodEntry(
        name="asymgs",
        summary="agrees with a slow average of itself, under two kinds of masks in turn",
        recipe="ambiguous_wild.methods.asymgs:build",
        paper="AsymGS, NeurIPS 2025 (arXiv 2506.03538), its EMA-GS form",
        note="features {features}, instances {instances}",
    ),
    MethodEntry(
        name="asymgs-twin",
        summary="two models under different masks are to agree; one of them is the result",
        recipe="ambiguous_wild.methods.asymgs:build_twin",
        paper="AsymGS, NeurIPS 2025 (arXiv 2506.03538), its GS-GS form",
    ),
    MethodEntry(
        name="spotlesssplats",
        summary="a small net on frozen features, held between two bounds of the residual, finds outliers",
        recipe="ambiguous_wild.methods.spotlesssplats:build",
        paper="SpotLessSplats (arXiv 2406.20055), its MLP form",
        note="features {features}",
    ),
    MethodEntry(
        name="spotlesssplats-cluster",
        summary="clusters of frozen features are static where most of their residuals are inliers",
        recipe="ambiguous_wild.methods.spotlesssplats:build",
        config="ambiguous_wild.methods.spotlesssplats:ClusterConfig",
        paper="SpotLessSplats (arXiv 2406.20055), its clustered form",
        note="features {features}",
    ),
    MethodEntry(
        name="mip-splatting",
        summary="no Gaussian smaller than any photo resolves, and a screen filter that keeps the brightness",
        recipe="ambiguous_wild.methods.mip:build",
        paper="Mip-Splatting, CVPR 2024",
    ),
    MethodEntry(
        name="gs-w",
        summary="colours by a net, from what each Gaussian is and what it samples in maps of its photo",
        recipe="ambiguous_wild.methods.gsw:build",
        ablations="ambiguous_wild.methods.ablation_groups:GSW",
        paper="Gaussian in the Wild, from its code",
    ),
    MethodEntry(
        name="splatfacto-w",
        summary="harmonics by a net of each Gaussian's feature and each photo's embedding, and a background",
        recipe="ambiguous_wild.methods.splatfactow:build",
        paper="Splatfacto-W, from its code",
    ),
    MethodEntry(
        name="swag",
        summary="a net of each photo's embedding and each Gaussian's place colours it, and may switch it off",
        recipe="ambiguous_wild.methods.swag:build",
        paper="SWAG (arXiv 2403.10427), its mechanism; sizes and rates are unverified",
    ),
    MethodEntry(
        name="nexussplats",
        summary="uncertainty of Gaussians, drawn like a colour, masks; light is a code beside each of them",
        recipe="ambiguous_wild.methods.nexussplats:build",
        paper="NexusSplats (arXiv 2411.14514), without anchors",
        note="features {features}",
    ),
    MethodEntry(
        name="hybridgs",
        summary="every photo has 2D Gaussians on its plane for what only it shows, added up, not blended",
        recipe="ambiguous_wild.methods.hybridgs:build",
        paper="HybridGS, CVPR 2025 (arXiv 2412.03844); its training is unverified",
    ),
    MethodEntry(
        name="t-3dgs",
        summary="masks pixels whose photo and render lead a head to different distributions of their errors",
        recipe="ambiguous_wild.methods.t3dgs:build",
        paper="T-3DGS (arXiv 2412.00155), its first stage",
        note="features {features}",
    ),
    MethodEntry(
        name="forestsplats",
        summary="one small transient field, bent for each photo by a net, shows where a net masks it",
        recipe="ambiguous_wild.methods.forestsplats:build",
        paper="ForestSplats, WACV 2026 (arXiv 2503.06179)",
    ),
    MethodEntry(
        name="uad",
        summary="growth by views that show a Gaussian large and unmasked; its formula is unverified",
        recipe="ambiguous_wild.methods.uad:build",
        paper="density control of ForestSplats (arXiv 2503.06179)",
    ),
    MethodEntry(
        name="3dgs+motion",
        summary="3dgs without what moves by geometry alone: features that do not fit the place",
        recipe="ambiguous_wild.methods.motion:build",
        needs="a scene of 'aw build-scene'",
    ),
    MethodEntry(
        name="3dgs+truth",
        summary="reference: 3dgs with the capture's exact masks",
        recipe="ambiguous_wild.methods.truth:build_masked",
        needs="a capture with exact truth",
    ),
    MethodEntry(
        name="3dgs-clean",
        summary="reference: 3dgs on the capture's photos without distractors",
        recipe="ambiguous_wild.methods.truth:build_clean",
        needs="a capture with exact truth",
    ),
)
