"""Tables laid out as papers have them, for text, Markdown, CSV, LaTeX and HTML."""
