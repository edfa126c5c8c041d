"""The parts that classes of models bring: each is found, and nothing else stands in the package of a class."""

import importlib
import inspect
import pkgutil
import re

import pytest

import nsmodel
from nsmodel.errors import ModelError
from nsmodel.modeling.base import Model
from nsmodel.modeling.parts import MODEL_CLASSES, Part

MODULES = [module.name for module in pkgutil.walk_packages(nsmodel.__path__, "nsmodel.") if not module.name.endswith("__main__")]
PARTS = {
    part.name: part
    for name in MODULES
    if re.search(r"^\w+ = Part\[", inspect.getsource(importlib.import_module(name)), re.MULTILINE)
    for part in vars(importlib.import_module(name)).values()
    if isinstance(part, Part)
}
WITHOUT = {  # What a class need not have.
    "function_values": {"SweepingProcess", "FrictionOscillator", "FirstOrderSystem", "LureSystem", "MechanicalSystem"},
    "impact_structure": {"SweepingProcess", "MonotoneInclusion", "ManyBodies", "MechanicalSystem"},
    "continuous_problem": {"ManyBodies", "MechanicalSystem"},
    "grid_propagator": set(MODEL_CLASSES) - {"ManyBodies"},
    "end_of_run": set(MODEL_CLASSES) - {"FrictionOscillator"},
    "library_files": set(MODEL_CLASSES) - {"ManyBodies"},
    "reference_step": {"ManyBodies", "MechanicalSystem"},
    "certificate_parts": {"MechanicalSystem"},
}


def test_parts_are_declared():
    assert len(PARTS) >= 12
    assert {"model_type", "schemes_by_name", "initial_checks", "hypothesis_checks", "certificate_parts"} <= set(PARTS)


@pytest.mark.parametrize("kind", MODEL_CLASSES)
def test_a_class_has_its_parts_and_its_package_nothing_else(kind):
    package = importlib.import_module(MODEL_CLASSES[kind])
    own = {name for name, value in vars(package).items() if inspect.isfunction(value)}
    assert own == {name for name in PARTS if kind not in WITHOUT.get(name, ())}
    model_type = getattr(nsmodel, kind)
    for name, part in PARTS.items():
        found = part.of_class_named(kind)
        assert (found is None) == (kind in WITHOUT.get(name, ()))
        assert part.optional(model_type) is found
        if found is not None:
            assert part.of(model_type) is found
        else:
            with pytest.raises(ModelError, match=f"{kind} has no part '{name}'"):
                part.of(model_type)


@pytest.mark.parametrize("kind", MODEL_CLASSES)
def test_schemes_are_those_that_the_class_names(kind):
    assert set(PARTS["schemes_by_name"].of_class_named(kind)) == set(getattr(nsmodel, kind).schemes)


@pytest.mark.parametrize("package", MODEL_CLASSES.values())
def test_no_part_has_the_name_of_a_module(package):
    modules = {module.name for module in pkgutil.iter_modules(importlib.import_module(package).__path__)}
    assert not modules & set(PARTS)


def test_a_class_from_elsewhere_is_refused():
    class LureSystem(Model):
        """Another class of that name."""

    for kind in (LureSystem, Model, int):
        with pytest.raises(ModelError, match="is not a class of models; expected one of SweepingProcess, "):
            PARTS["model_type"].of(kind)
    assert PARTS["model_type"].of_class_named("Pendulum") is None
    assert PARTS["model_type"].of_class_named(None) is None
