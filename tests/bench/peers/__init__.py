"""Other programs on the scenes of ``cases/``: Siconos, nosnoc, SciPy on regularised laws; nothing here is needed by nsmodel."""
