"""What is taken where the user says nothing."""

TOLERANCE = 1e-9  # The largest residual of a step that is accepted.
LEAST_TOLERANCE = 1e-14  # Below it there is rounding alone.
