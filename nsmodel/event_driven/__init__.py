"""Solutions as one smooth piece after another: what they are made of.

"(+)" behind a number: ten times it and a tenth of it (of a whole number twice and half) change no bit of the runs of
``python -m tests.search.constants``; "(~)": of these runs none stops, and none moves by more than ten times what it is asked for.
"""
