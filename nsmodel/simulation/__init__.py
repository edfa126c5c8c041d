"""A run: one loop over whatever advances a model, every step verified, nothing lost when it stops.

"(+)" behind a number: ten times it and a tenth of it (of a whole number twice and half) change no bit of the runs of
``python -m tests.search.constants``; "(~)": of these runs none stops, and none moves by more than ten times what it is asked for.
"""
