"""Public datasets: read their layouts, fetch them, package scenes for release, export scenes."""
