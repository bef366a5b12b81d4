"""Distractors with exact masks, added to a scene of real photos."""
