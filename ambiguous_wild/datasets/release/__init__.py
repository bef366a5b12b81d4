"""Scenes packed for release, and the check of such a package."""
