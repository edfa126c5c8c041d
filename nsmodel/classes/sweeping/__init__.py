"""Sweeping processes: -q' ∈ N_Q(t)(q) - f(t, q), Q(t) = {g_i(t, q) >= 0}."""
