"""Many bodies: what the class brings to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsmodel.certificate.data import CertificateParts
    from nsmodel.codegen.export import LibraryFiles
    from nsmodel.hypotheses.framework import HypothesisChecks
    from nsmodel.modeling.base import Model
    from nsmodel.simulation.propagator import GridPropagator
    from nsmodel.solvers.initial_checks import InitialChecks
    from nsmodel.solvers.one_step_problem import Scheme


def model_type() -> type[Model]:
    """Return the class."""
    from nsmodel.classes.bodies.model import ManyBodies

    return ManyBodies


def function_values() -> Callable[..., Sequence[Any]]:
    """Return the values by which its functions in Python are known."""
    from nsmodel.classes.bodies.identity import values_of_functions

    return values_of_functions


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its schemes."""
    from nsmodel.classes.bodies.schemes import prediction_correction
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "prediction-correction": Scheme(
            one_step_problem=prediction_correction.one_step_problem, initial_rows=prediction_correction.one_step_problem
        ),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.classes.bodies.hypotheses import quick
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(warnings=quick.warnings)


def grid_propagator() -> GridPropagator:
    """Return what steps many bodies over a grid."""
    from nsmodel.classes.bodies.walk import ManyBodiesPropagator

    return ManyBodiesPropagator


def library_files() -> LibraryFiles:
    """Return what writes its library in C."""
    from nsmodel.codegen.bodies import bodies_library_files

    return bodies_library_files


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.classes.bodies.hypotheses import along, check, driven, effort, for_all, pace
    from nsmodel.hypotheses.framework import DrivenChecks, HypothesisChecks, UniformChecks

    return HypothesisChecks(
        hypotheses=check.HYPOTHESES,
        decide=check.check,
        along_run=along.class_findings_along_run,
        run_hypotheses=along.RUN_HYPOTHESES,
        uniform=UniformChecks(
            special_values=for_all.special_values, findings=for_all.uniform_findings, consequences=for_all.uniform_consequences
        ),
        driven=DrivenChecks(
            fields=driven.DRIVEN_FIELDS, findings=driven.driven_findings, consequences=driven.driven_consequences
        ),
        speed_bound=pace.speed_bound,
        effort=effort,
    )


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.classes.bodies import equations

    return equations.equations


def certificate_parts() -> CertificateParts:
    """Return what writes its certificates."""
    from nsmodel.certificate.data import CertificateParts
    from nsmodel.classes.bodies import certificate
    from nsmodel.classes.sweeping.certificate import proofs

    return CertificateParts(stated=certificate.STATED, subject=certificate.subject, proofs=proofs)
