"""What is taken where the user says nothing."""

DEFAULT_TOLERANCE = 1e-9  # The largest residual of a step that is accepted.
MIN_TOLERANCE = 1e-14  # Below it there is rounding alone.
