"""Derivatives of runs by parameters, starts and the numbers of signals."""
