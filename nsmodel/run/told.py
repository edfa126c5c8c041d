"""What a trajectory tells of its model and of its scheme, however it was made."""

from __future__ import annotations

from typing import Any

import casadi as ca

from nsmodel.identity import versions
from nsmodel.model.base import Model
from nsmodel.model.quantity import Quantity
from nsmodel.scheme.problem import OneStepProblem


def model_metadata(model: Model) -> dict[str, Any]:
    """Names, units, numbers, and the versions of what they were made with."""
    data: dict[str, Any] = {
        "title": model.title,
        "model_class": type(model).__name__,
        "paper": model.paper,
        "state_names": list(model.names),
        "stems": {stem: list(at) for stem, at in model.stems.items()},
        "units": dict(model.units),
        "parameters": dict(model.bound_parameters),
        "versions": versions(),
    }
    if model.input_groups:
        data["input_names"] = list(model.input_names)  # In order: of a dictionary files keep none.
        data["input_groups"] = {name: list(names) for name, names in model.input_groups.items()}
    if model.outputs:
        data["outputs"] = {name: Quantity.made(expression).text for name, expression in model.outputs.items()}
    if model.weights is not None:
        data["weights"] = list(map(float, model.weights))
    scene: Any = getattr(model, "scene", None)
    return data | ({"scene": {key: value.tolist() for key, value in scene.items()}} if scene else {})


def scheme_metadata(problem: OneStepProblem, tolerance: float) -> dict[str, Any]:
    """Its name, the names of its rows, what was accepted."""
    return {
        "scheme": problem.scheme,
        "multiplier_names": list(problem.multiplier_names),
        "index_names": list(problem.rows),
        "law_kinds": problem.law.labels,
        "tolerance": tolerance,
    }


def scene_metadata(model: Any) -> dict[str, Any]:
    """Of a planar scene of discs: for each constraint those whose coordinates it contains; nothing of other models."""
    if not getattr(model, "scene", None):
        return {}
    bodies: list[set[int]] = [set() for _ in range(model.g.numel())]
    for row, column in zip(*ca.jacobian(model.g, model.q).sparsity().get_triplet(), strict=True):
        bodies[row].add(column // 2)
    return {"constraint_bodies": [sorted(found) for found in bodies]}
