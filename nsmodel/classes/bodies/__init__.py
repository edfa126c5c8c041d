"""Sweeping processes of many bodies, their constraints in families."""
