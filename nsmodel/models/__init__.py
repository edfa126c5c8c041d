"""The classes of models, a folder each: the model, its schemes, its hypotheses; and crowds, which are models of many bodies."""
