"""Results as HTML for notebooks: a module for each kind, ``html(result) -> str``; no script, escaped in one place (`page`)."""
