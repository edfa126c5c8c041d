"""Many bodies: what the class brings to the rest of the package."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from nsmodel.codegen.export import LibraryFiles
    from nsmodel.hypotheses.certificates.write import CertificateParts
    from nsmodel.hypotheses.framework import HypothesisChecks
    from nsmodel.modeling.base import Model
    from nsmodel.simulation.propagator import GridPropagator
    from nsmodel.solvers.initial_checks import InitialChecks
    from nsmodel.solvers.one_step_problem import Scheme


def model_type() -> type[Model]:
    """Return the class."""
    from nsmodel.models.many_bodies.model import ManyBodies

    return ManyBodies


def function_values() -> Callable[..., Sequence[Any]]:
    """Return the values by which its functions in Python are known."""
    from nsmodel.models.many_bodies.model import values_of_functions

    return values_of_functions


def schemes_by_name() -> Mapping[str, Scheme]:
    """Return its schemes."""
    from nsmodel.models.many_bodies import schemes
    from nsmodel.solvers.one_step_problem import Scheme

    return {
        "prediction-correction": Scheme(one_step_problem=schemes.one_step_problem, initial_rows=schemes.one_step_problem),
    }


def initial_checks() -> InitialChecks:
    """Return what is looked at before a run."""
    from nsmodel.models.many_bodies import schemes
    from nsmodel.solvers.initial_checks import InitialChecks

    return InitialChecks(warnings=schemes.warnings)


def grid_propagator() -> GridPropagator:
    """Return what steps many bodies over a grid."""
    from nsmodel.models.many_bodies.propagator import ManyBodiesPropagator

    return ManyBodiesPropagator


def library_files() -> LibraryFiles:
    """Return what writes its library in C."""
    from nsmodel.models.many_bodies.step_library import bodies_library_files

    return bodies_library_files


def hypothesis_checks() -> HypothesisChecks:
    """Return its hypotheses, and what decides them."""
    from nsmodel.hypotheses.framework import DrivenChecks, HypothesisChecks, UniformChecks
    from nsmodel.models.many_bodies import check, inputs_and_parameters
    from nsmodel.models.many_bodies import check as along
    from nsmodel.models.many_bodies import check as effort

    return HypothesisChecks(
        hypotheses=check.HYPOTHESES,
        decide=check.check,
        along_run=along.class_findings_along_run,
        run_hypotheses=along.RUN_HYPOTHESES,
        uniform=UniformChecks(
            special_values=inputs_and_parameters.special_values,
            findings=inputs_and_parameters.uniform_findings,
            consequences=inputs_and_parameters.uniform_consequences,
        ),
        driven=DrivenChecks(
            fields=inputs_and_parameters.DRIVEN_FIELDS,
            findings=inputs_and_parameters.driven_findings,
            consequences=inputs_and_parameters.driven_consequences,
        ),
        speed_bound=inputs_and_parameters.speed_bound,
        effort=effort,
    )


def latex_equations() -> Callable[[Any], list[str]]:
    """Return what writes its equations in LaTeX."""
    from nsmodel.models.many_bodies import documents

    return documents.equations


def certificate_parts() -> CertificateParts:
    """Return what writes its certificates."""
    from nsmodel.hypotheses.certificates.write import CertificateParts
    from nsmodel.models.many_bodies import documents

    return CertificateParts(stated=documents.STATED, subject=documents.subject, proofs=documents.proofs)
