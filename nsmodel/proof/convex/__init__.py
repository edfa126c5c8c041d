"""Convexity of potentials and sets, and where they are least: proved by rules, bounds and exact arithmetic."""
