"""Certificates: what proves each finding that holds, as data that ``verify.py`` checks without this package."""
