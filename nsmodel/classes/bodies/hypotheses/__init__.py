"""Sweeping processes of many bodies: each hypothesis once a family."""
