"""How a model behaves when pushed: its step, its units and its parameters, each run judged by what the solvers do not know."""

from nsmodel.stress.cells import stress, stress_variants
from nsmodel.stress.result import LEFT_OUT, RIGHT, STOPPED, WRONG, Cell, Stress

__all__ = ["LEFT_OUT", "RIGHT", "STOPPED", "WRONG", "Cell", "Stress", "stress", "stress_variants"]
