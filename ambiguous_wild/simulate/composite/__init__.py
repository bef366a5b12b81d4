"""Distractors with exact masks on a scene of real photographs."""
