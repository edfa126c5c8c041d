"""Solutions as one smooth piece after another: what they are made of."""
