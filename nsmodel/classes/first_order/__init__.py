"""First-order systems M x' = f + g(x, l), y = h(x, l), -y ∈ N_K(l)."""
