"""A document as data, and what renders it: Typst, Markdown, LaTeX."""
