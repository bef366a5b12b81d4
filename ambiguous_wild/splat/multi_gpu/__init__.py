"""One model on several GPUs: each holds a share of the Gaussians and draws photos of its own.

Source: gsplat's distributed mode, after On Scaling Up 3D Gaussian Splatting Training (arXiv 2406.18533).
"""
