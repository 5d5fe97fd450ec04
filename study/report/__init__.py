"""The report of a sweep: one model, figures, and renderers for Typst and Markdown."""
