"""Hypotheses of the theta-gamma scheme for first-order nonsmooth systems."""
