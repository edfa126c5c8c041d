"""Oscillators with dry friction: x'' + A(x') + dg(x) ∋ f(t)."""
