"""Hypotheses of maximal monotone inclusions by catching-up (2026)."""
