"""Which optional effects a scene calls for: evidence, threshold, decision, cost."""
