"""nsmodel: nonsmooth dynamics on CasADi. Declare a model, run it, and get a trajectory in which every step was verified."""

from typing import TYPE_CHECKING

from nsmodel._utils import lazy_attributes as _later
from nsmodel.errors import (
    MissingExtraError,
    ModelError,
    NsmodelError,
    PlotError,
    StepError,
    StorageError,
    UnverifiedWarning,
    UsageError,
)
from nsmodel.modeling import former_names
from nsmodel.modeling.laws import (
    Law,
    ball,
    box,
    complementarity,
    coulomb,
    ellipsoid,
    equality,
    polyhedron,
    product,
    relay,
    second_order_cone,
)
from nsmodel.modeling.model_files import load
from nsmodel.modeling.signals import Signal, Within, pwm, signal, steps, table, within
from nsmodel.modeling.standard_blocks import Block, dead_time, delay, each_step, hysteresis, latch, pid, sampled, thyristor
from nsmodel.version import VERSION

__version__ = VERSION

if TYPE_CHECKING:
    from nsmodel.derivatives.result import Sensitivity
    from nsmodel.derivatives.sensitivity import sensitivity
    from nsmodel.hypotheses.check import check
    from nsmodel.hypotheses.findings import Finding
    from nsmodel.hypotheses.report import Report
    from nsmodel.models.first_order_system.model import FirstOrderSystem
    from nsmodel.models.friction_oscillator.model import FrictionOscillator
    from nsmodel.models.lure_system.model import LureSystem
    from nsmodel.models.many_bodies.families import Bodies, Family, Items, neighbours
    from nsmodel.models.many_bodies.model import ManyBodies
    from nsmodel.models.mechanical_system.model import Contact, MechanicalSystem
    from nsmodel.models.monotone_inclusion.model import MonotoneInclusion
    from nsmodel.models.sweeping_process.model import SweepingProcess
    from nsmodel.simulation.loop import RunInterrupted
    from nsmodel.simulation.prepared import PreparedRun, prepare
    from nsmodel.simulation.simulate import explain, simulate
    from nsmodel.simulation.stepper import ModelStepper, stepper
    from nsmodel.simulation.trajectory import Trajectory
    from nsmodel.study import Study, study
    from nsmodel.study.stress import Stress, stress
    from nsmodel.sweep import Sweep, SweepInterrupted, share, statistics, sweep

__all__ = [
    "Block",
    "Bodies",
    "Contact",
    "Family",
    "Finding",
    "FirstOrderSystem",
    "FrictionOscillator",
    "Items",
    "Law",
    "LureSystem",
    "ManyBodies",
    "MechanicalSystem",
    "MissingExtraError",
    "ModelError",
    "ModelStepper",
    "MonotoneInclusion",
    "NsmodelError",
    "PlotError",
    "PreparedRun",
    "Report",
    "RunInterrupted",
    "Sensitivity",
    "Signal",
    "StepError",
    "StorageError",
    "Stress",
    "Study",
    "Sweep",
    "SweepInterrupted",
    "SweepingProcess",
    "Trajectory",
    "UnverifiedWarning",
    "UsageError",
    "Within",
    "ball",
    "box",
    "check",
    "complementarity",
    "coulomb",
    "dead_time",
    "delay",
    "each_step",
    "ellipsoid",
    "equality",
    "explain",
    "hysteresis",
    "latch",
    "load",
    "neighbours",
    "pid",
    "polyhedron",
    "prepare",
    "product",
    "pwm",
    "relay",
    "sampled",
    "second_order_cone",
    "sensitivity",
    "share",
    "signal",
    "simulate",
    "statistics",
    "stepper",
    "steps",
    "stress",
    "study",
    "sweep",
    "table",
    "thyristor",
    "within",
]

former_names.install()
_later(
    __name__,
    {
        "nsmodel.derivatives.result": ["Sensitivity"],
        "nsmodel.derivatives.sensitivity": ["sensitivity"],
        "nsmodel.hypotheses.check": ["check"],
        "nsmodel.hypotheses.findings": ["Finding"],
        "nsmodel.hypotheses.report": ["Report"],
        "nsmodel.models.many_bodies.families": ["Bodies", "Family", "Items", "neighbours"],
        "nsmodel.models.many_bodies.model": ["ManyBodies"],
        "nsmodel.models.first_order_system.model": ["FirstOrderSystem"],
        "nsmodel.models.mechanical_system.model": ["Contact", "MechanicalSystem"],
        "nsmodel.models.monotone_inclusion.model": ["MonotoneInclusion"],
        "nsmodel.models.lure_system.model": ["LureSystem"],
        "nsmodel.models.friction_oscillator.model": ["FrictionOscillator"],
        "nsmodel.models.sweeping_process.model": ["SweepingProcess"],
        "nsmodel.simulation.loop": ["RunInterrupted"],
        "nsmodel.simulation.prepared": ["PreparedRun", "prepare"],
        "nsmodel.simulation.simulate": ["explain", "simulate"],
        "nsmodel.simulation.stepper": ["ModelStepper", "stepper"],
        "nsmodel.study.stress": ["Stress", "stress"],
        "nsmodel.study": ["Study", "study"],
        "nsmodel.sweep": ["Sweep", "SweepInterrupted", "share", "statistics", "sweep"],
        "nsmodel.simulation.trajectory": ["Trajectory"],
    },
)
