"""A run: one loop over whatever advances a model, every step verified, nothing lost when it stops."""
