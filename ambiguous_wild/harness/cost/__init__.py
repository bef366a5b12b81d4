"""Accuracy against cost: time to reach a PSNR, dB per minute, Pareto-optimal methods."""
