"""Comparisons of runs: one table, its formats, and the layouts of papers."""
