"""Monotone inclusions x' ∈ F(x) - T(x)."""
