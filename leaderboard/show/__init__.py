"""Numbers as Markdown, LaTeX, CSV, in a terminal, and as figures."""
