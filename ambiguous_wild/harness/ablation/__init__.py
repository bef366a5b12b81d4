"""Ablations: a study of variants, and its report."""
