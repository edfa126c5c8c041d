"""Oscillators with dry friction: x'' + A(x') + dg(x) ∋ 0."""
