"""Other people's programs as methods: they train and render, our harness measures what they wrote."""
