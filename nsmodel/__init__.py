"""nsmodel: nonsmooth dynamics on CasADi. Declare a model, run it, and get a trajectory in which every step was verified."""

from typing import TYPE_CHECKING

from nsmodel.errors import (
    MissingExtraError,
    ModelError,
    NsmodelError,
    PlotError,
    StepError,
    StorageError,
    UsageError,
)
from nsmodel.later import later as _later
from nsmodel.laws import (
    Law,
    ball,
    box,
    complementarity,
    ellipsoid,
    equality,
    polyhedron,
    product,
    relay,
    second_order_cone,
)
from nsmodel.loader import load
from nsmodel.version import VERSION

__version__ = VERSION

if TYPE_CHECKING:
    from nsmodel.checking import check
    from nsmodel.hypotheses.findings import Finding, Report
    from nsmodel.model.bodies import Bodies, Family, Items, ManyBodies, neighbours
    from nsmodel.model.first_order import FirstOrderSystem
    from nsmodel.model.inclusion import MonotoneInclusion
    from nsmodel.model.lure import LureSystem
    from nsmodel.model.oscillator import FrictionOscillator
    from nsmodel.model.sweeping import SweepingProcess
    from nsmodel.run import RunInterrupted
    from nsmodel.simulate import explain, simulate
    from nsmodel.stress import Stress, stress
    from nsmodel.study import Study, study
    from nsmodel.trajectory import Trajectory

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
    "ellipsoid",
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

_later(
    __name__,
    {
        "nsmodel.checking": ["check"],
        "nsmodel.hypotheses.findings": ["Finding", "Report"],
        "nsmodel.model.bodies": ["Bodies", "Family", "Items", "ManyBodies", "neighbours"],
        "nsmodel.model.first_order": ["FirstOrderSystem"],
        "nsmodel.model.inclusion": ["MonotoneInclusion"],
        "nsmodel.model.lure": ["LureSystem"],
        "nsmodel.model.oscillator": ["FrictionOscillator"],
        "nsmodel.model.sweeping": ["SweepingProcess"],
        "nsmodel.run": ["RunInterrupted"],
        "nsmodel.simulate": ["explain", "simulate"],
        "nsmodel.stress": ["Stress", "stress"],
        "nsmodel.study": ["Study", "study"],
        "nsmodel.trajectory": ["Trajectory"],
    },
)
