"""Modules and classes as earlier versions named them, in pickles and in programs: found under the names that they have now."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

PACKAGE = "nsmodel"
PACKAGES = {
    "blocks": "modeling.standard_blocks",
    "classes": "models",
    "classes.bodies": "models.many_bodies",
    "classes.first_order": "models.first_order_system",
    "classes.inclusion": "models.monotone_inclusion",
    "classes.lure": "models.lure_system",
    "classes.oscillator": "models.friction_oscillator",
    "classes.sweeping": "models.sweeping_process",
    "laws": "modeling.laws",
    "model": "modeling",
    "signals": "modeling.signals",
    "stress": "study.stress",
}
MODULES = PACKAGES | {
    "blocks.block": "modeling.block",
    "blocks.common": "modeling.standard_blocks",
    "checking": "hypotheses.check",
    "classes.bodies.groups": "models.many_bodies.families",
    "classes.bodies.model": "models.many_bodies.model",
    "classes.first_order.model": "models.first_order_system.model",
    "classes.inclusion.model": "models.monotone_inclusion.model",
    "classes.lure.model": "models.lure_system.model",
    "classes.oscillator.model": "models.friction_oscillator.model",
    "classes.sweeping.model": "models.sweeping_process.model",
    "contacts": "solvers.contacts",
    "crowd.noise": "models.crowd.people",
    "crowd.paths": "models.crowd.paths",
    "crowd.people": "models.crowd.people",
    "crowd.room": "models.crowd.room",
    "dense": "event_driven.dense_output",
    "grid": "modeling.time_grid",
    "hypotheses.report.report": "hypotheses.report",
    "hypotheses.scope": "hypotheses.findings",
    "laws.ball": "modeling.laws.ball",
    "laws.block": "modeling.laws.base",
    "laws.box": "modeling.laws.box",
    "laws.cone": "modeling.laws.cone",
    "laws.curved": "modeling.laws.base",
    "laws.ellipsoid": "modeling.laws.ellipsoid",
    "laws.given": "modeling.laws.base",
    "laws.law": "modeling.laws.base",
    "laws.moving": "modeling.laws.base",
    "laws.polyhedron": "modeling.laws.polyhedron",
    "model.arguments": "modeling.parameters",
    "model.base": "modeling.base",
    "model.blocks": "modeling.blocks",
    "model.convert": "modeling.conversion",
    "model.convex": "modeling.convex_split",
    "model.convex_read": "modeling.convex_split",
    "model.documented": "modeling.base",
    "model.driven": "modeling.variants",
    "model.driving": "modeling.inputs",
    "model.exact": "modeling.outputs",
    "model.expressions": "modeling.expressions",
    "model.facts": "modeling.description",
    "model.from_sympy": "modeling.conversion",
    "model.inputs": "modeling.inputs",
    "model.outputs": "modeling.outputs",
    "model.parameters": "modeling.parameters",
    "model.quantity": "modeling.outputs",
    "model.replaced": "modeling.parameters",
    "model.started": "modeling.variants",
    "model.symbols": "modeling.conversion",
    "model.tables": "modeling.expressions",
    "model.ticks": "modeling.blocks",
    "model_files": "modeling.pickling",
    "pickled": "modeling.pickling",
    "plot.shown": "plot.notebook_figures",
    "signals.bounds": "modeling.signals.base",
    "signals.drive": "modeling.signals.schedule",
    "signals.function": "modeling.signals.function",
    "signals.kept": "modeling.signals.pwm",
    "signals.pwm": "modeling.signals.pwm",
    "signals.signal": "modeling.signals.base",
    "signals.steps": "modeling.signals.table",
    "signals.table": "modeling.signals.table",
    "signals.within": "modeling.signals.base",
    "simulate": "simulation.simulate",
    "stress.cells": "study.stress",
    "stress.judge": "study.reference_steps",
    "stress.measures": "study.reference_steps",
    "stress.moving": "study.reference_steps",
    "stress.result": "study.stress_result",
    "stress.theta_gamma": "study.reference_steps",
    "study.between": "study.reference",
    "study.measure": "study.work_precision",
    "study.search": "study.work_precision",
    "study.text": "study.result",
    "sweep.asked": "sweep.request",
    "sweep.binomial": "sweep.statistics",
    "sweep.choice": "sweep.cells",
    "sweep.dataset": "sweep.result",
    "sweep.engine": "sweep.executor",
    "sweep.files": "sweep.store",
    "sweep.outputs": "sweep.request",
    "sweep.same": "sweep.store",
    "sweep.shares": "sweep.statistics",
    "sweep.source": "sweep.groups",
    "sweep.table": "sweep.statistics",
    "sweep.tasks": "sweep.groups",
    "sweep.work": "sweep.executor",
    "trajectory": "simulation.trajectory",
}
INSIDE_MODULES = "crowd.", "hypotheses.report."
CLASSES = {
    "classes.bodies.groups.Member": "GroupMember",
    "crowd.noise.Wavering": "NoisyVelocity",
    "crowd.room.Grid": "RoomGrid",
    "grid.Grid": "TimeGrid",
    "model.convex.Term": "ConvexTerm",
    "model.exact.Sampled": "SampledExactState",
    "model.quantity.ByName": "SymbolsByName",
    "model.tables.Table": "InterpolationTable",
    "signals.bounds.Ends": "SizedBounds",
    "signals.bounds.Jump": "SignalJump",
    "signals.function.Declared": "EdgeDeclaredSignal",
    "signals.kept.Kept": "HeldSignal",
    "signals.signal.Held": "ConstantSignal",
    "sweep.asked.Asked": "SweepRequest",
    "sweep.asked.Rows": "RowSelection",
    "sweep.choice.Choice": "BackendChoice",
    "sweep.same.Binding": "SweepBinding",
    "sweep.source.Source": "ModelSource",
    "sweep.tasks.Groups": "ModelGroups",
}


class FormerModule(ModuleType):
    """A former module, whose names stay what they are when a module in it is imported that is called as one of them."""

    def __setattr__(self, name: str, value: Any) -> None:
        """Set it, but for such a module, which the import of it sets."""
        if not (isinstance(value, ModuleType) and hasattr(self, name)):
            super().__setattr__(name, value)


class FormerModules(MetaPathFinder, Loader):
    """Finds a former module as one whose names are those of the module that has them now."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the specification of a former module of this package; None of any other."""
        package, _, name = fullname.partition(".")
        if package != PACKAGE or name not in MODULES:
            return None
        return ModuleSpec(fullname, self, is_package=name in PACKAGES)

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Return a module without names."""
        return FormerModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Let the module find its names in the one that has them now, when they are asked for."""
        former = module.__name__.partition(".")[2]

        def __getattr__(name: str) -> Any:
            if name.startswith("__"):
                raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
            found = CLASSES.get(f"{former}.{name}", name)
            return getattr(import_module(f"{PACKAGE}.{MODULES[former]}"), found)

        vars(module)["__getattr__"] = __getattr__


def install() -> None:
    """Let imports find former modules, after all others.

    No finder is asked for a module inside of what is no package any more: those are loaded here.
    """
    if not any(isinstance(finder, FormerModules) for finder in sys.meta_path):
        sys.meta_path.append(FormerModules())
    for name in MODULES:
        if name.startswith(INSIDE_MODULES):
            finder, module = FormerModules(), ModuleType(f"{PACKAGE}.{name}")
            finder.exec_module(module)
            sys.modules.setdefault(module.__name__, module)
