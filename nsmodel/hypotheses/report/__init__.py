"""A report as text, data, Markdown and LaTeX."""
