"""A search for steps that are refused though they have a solution, and for steps that are done and wrong.

``python -m tests.search`` draws random models, runs them, and judges steps by truths of 60 digits that owe nothing to the
certificate: the equations of the step solved on an index set, whose signs are then verified in the same digits.
"""
