"""Hypotheses of sweeping processes (Bernicot and Venel 2010)."""
