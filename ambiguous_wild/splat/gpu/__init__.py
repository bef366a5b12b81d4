"""Rendering and training on one GPU: gsplat behind one module, the fused loss, checks without waiting."""
