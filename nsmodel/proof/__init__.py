"""Means of proof: rigorous bounds over boxes, exact rational arithmetic, certificates of feasibility."""
