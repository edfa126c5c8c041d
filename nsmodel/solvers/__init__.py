"""From the one-step problem to a verified step."""
