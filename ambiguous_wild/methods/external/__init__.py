"""External programs as methods: they train and render, our harness measures their pictures."""
