"""Hypotheses of the papers."""
