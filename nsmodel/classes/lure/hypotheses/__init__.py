"""Hypotheses of multivalued Lur'e systems (Brogliato and Goeleven 2013)."""
