"""Event-driven integration as a prototype in C++, CVODE on the same modes, and SciPy: peers of event-driven runs."""
