"""Show trained models: pages, videos, exported files, a live view. Knows models and scenes, not runs."""
