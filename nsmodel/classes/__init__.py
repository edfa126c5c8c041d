"""The classes of models, a folder each: the model, its schemes, its hypotheses."""
