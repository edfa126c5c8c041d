"""The parts that classes of models bring: each is found, and nothing else stands in the package of a class."""

import importlib
import inspect
import pkgutil
import re

import pytest

import nsmodel
from nsmodel.errors import ModelError
from nsmodel.modeling.base import Model
from nsmodel.modeling.parts import MODEL_CLASSES, Part, class_named

MODULES = [module.name for module in pkgutil.walk_packages(nsmodel.__path__, "nsmodel.") if not module.name.endswith("__main__")]
PARTS = {
    part.name: part
    for name in MODULES
    if re.search(r"^\w+ = Part\[", inspect.getsource(importlib.import_module(name)), re.MULTILINE)
    for part in vars(importlib.import_module(name)).values()
    if isinstance(part, Part)
}
WITHOUT = {  # What a class need not have.
    "model.values_of_functions": {"SweepingProcess", "FrictionOscillator", "FirstOrderSystem", "LureSystem", "MechanicalSystem"},
    "schemes.impact_system": {"SweepingProcess", "MonotoneInclusion", "ManyBodies", "MechanicalSystem"},
    "schemes.continuous_problem": {"ManyBodies", "MechanicalSystem"},
    "propagator.GRID_PROPAGATOR": set(MODEL_CLASSES) - {"ManyBodies"},
    "finite_convergence.finite_convergence": set(MODEL_CLASSES) - {"FrictionOscillator"},
    "step_library.library_files": set(MODEL_CLASSES) - {"ManyBodies"},
    "reference_steps.REFERENCE_STEP": {"ManyBodies", "MechanicalSystem"},
    "documents.CERTIFICATE": {"MechanicalSystem"},
}


def test_parts_are_declared():
    assert len(PARTS) >= 11
    assert {"schemes.SCHEMES", "schemes.INITIAL_CHECKS", "hypothesis_checks", "documents.CERTIFICATE"} <= set(PARTS)


@pytest.mark.parametrize("kind", MODEL_CLASSES)
def test_a_class_has_its_parts_and_its_package_nothing_else(kind):
    package = importlib.import_module(MODEL_CLASSES[kind])
    own = {name for name, value in vars(package).items() if inspect.isfunction(value)}
    assert own == {"hypothesis_checks"}
    model_type = getattr(nsmodel, kind)
    for name, part in PARTS.items():
        found = part.optional(model_type)
        assert (found is None) == (kind in WITHOUT.get(name, ()))
        if found is not None:
            assert part.of(model_type) is found
        else:
            with pytest.raises(ModelError, match=f"{kind} has no part '{re.escape(name)}'"):
                part.of(model_type)


@pytest.mark.parametrize("kind", MODEL_CLASSES)
def test_schemes_are_those_that_the_class_names(kind):
    assert set(PARTS["schemes.SCHEMES"].of(getattr(nsmodel, kind))) == set(getattr(nsmodel, kind).schemes)


def test_a_class_from_elsewhere_is_refused():
    class LureSystem(Model):
        """Another class of that name."""

    for kind in (LureSystem, Model, int):
        with pytest.raises(ModelError, match="is not a class of models; expected one of SweepingProcess, "):
            PARTS["schemes.SCHEMES"].of(kind)

    assert class_named("LureSystem") is nsmodel.LureSystem
    assert class_named("Pendulum") is None
    assert class_named(None) is None
