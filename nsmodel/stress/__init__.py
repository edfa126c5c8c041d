"""How a model behaves when pushed: its step, its units and its parameters, each run judged by what the solvers do not know."""

from nsmodel.stress.cells import push, stress
from nsmodel.stress.result import LEFT_OUT, RIGHT, STOPPED, WRONG, Cell, Stress

__all__ = ["LEFT_OUT", "RIGHT", "STOPPED", "WRONG", "Cell", "Stress", "push", "stress"]
