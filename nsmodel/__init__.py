"""nsmodel: nonsmooth dynamics on CasADi. Declare a model, run it, and get a trajectory in which every step was verified."""

from importlib.metadata import version

from nsmodel.checking import check
from nsmodel.errors import (
    MissingExtraError,
    ModelError,
    NsmodelError,
    PlotError,
    StepError,
    StorageError,
    UsageError,
)
from nsmodel.hypotheses.findings import Finding, Report
from nsmodel.loader import load
from nsmodel.model.bodies import Bodies, Family, Items, ManyBodies, neighbours
from nsmodel.model.first_order import FirstOrderSystem
from nsmodel.model.inclusion import MonotoneInclusion
from nsmodel.model.laws import (
    Law,
    ball,
    box,
    complementarity,
    equality,
    polyhedron,
    product,
    relay,
    second_order_cone,
)
from nsmodel.model.lure import LureSystem
from nsmodel.model.oscillator import FrictionOscillator
from nsmodel.model.sweeping import SweepingProcess
from nsmodel.run import RunInterrupted
from nsmodel.simulate import explain, simulate
from nsmodel.stress import Stress, stress
from nsmodel.study import Study, study
from nsmodel.trajectory import Trajectory

__version__ = version("nsmodel")

__all__ = [
    "Bodies",
    "Family",
    "Finding",
    "FirstOrderSystem",
    "FrictionOscillator",
    "Items",
    "Law",
    "LureSystem",
    "ManyBodies",
    "MissingExtraError",
    "ModelError",
    "MonotoneInclusion",
    "NsmodelError",
    "PlotError",
    "Report",
    "RunInterrupted",
    "StepError",
    "StorageError",
    "Stress",
    "Study",
    "SweepingProcess",
    "Trajectory",
    "UsageError",
    "ball",
    "box",
    "check",
    "complementarity",
    "equality",
    "explain",
    "load",
    "neighbours",
    "polyhedron",
    "product",
    "relay",
    "second_order_cone",
    "simulate",
    "stress",
    "study",
]
