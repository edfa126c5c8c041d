"""Hypotheses of oscillators under dry friction (Cabot 2004)."""
