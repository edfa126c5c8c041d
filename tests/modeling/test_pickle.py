"""Models, laws, families, reports and runs go to other processes and come back, exactly; deep copies stand on their own."""

import copy
import dataclasses
import gc
import importlib
import inspect
import multiprocessing
import pickle
import textwrap
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT, FULL

import nsmodel
from nsmodel import (
    Bodies,
    Family,
    FirstOrderSystem,
    Items,
    LureSystem,
    ManyBodies,
    MonotoneInclusion,
    RunInterrupted,
    StepError,
    Stress,
    Study,
    SweepingProcess,
    UsageError,
    ball,
    box,
    check,
    complementarity,
    equality,
    hysteresis,
    polyhedron,
    product,
    relay,
    second_order_cone,
    simulate,
)
from nsmodel.hypotheses.region import region_of
from nsmodel.modeling import former_names
from nsmodel.modeling.fingerprint import fingerprint
from nsmodel.modeling.parts import MODEL_CLASSES
from nsmodel.modeling.time_grid import make_grid
from nsmodel.study import Line, StudyInterrupted
from nsmodel.study.reference import ReferenceRows, closed_form_reference
from nsmodel.study.stress import Cell

t, x, y, l, k = ca.SX.sym("t"), ca.SX.sym("x", 2), ca.SX.sym("y", 2), ca.SX.sym("l"), ca.SX.sym("k")
CASES_FOLDER = Path(__file__).parents[2] / "cases"
FIXTURES = Path(__file__).parents[1] / "fixtures" / "pickles"
NEIGHBOUR = "def exact(t):\n    import numpy as np\n\n    return np.exp(-np.outer(t, [1, 1]))\n"
FILE = """
import casadi as ca
import neighbour
from nsmodel import MonotoneInclusion

def fine(mu):
    return mu**3

x = ca.SX.sym("x", 2)
model = MonotoneInclusion(x=x, field=-x, x0=[1, 1], t_end=1, step=0.1, exact=neighbour.exact, tolerances=fine, title="By file")
"""


def again(value):
    return pickle.loads(pickle.dumps(value))


def mark(model):
    bound = model.bind({name: 2 for name, value in model.parameters.items() if value is None})
    return fingerprint(bound, make_grid(bound, None, None, None))


def measured_from(run):
    """Return a study with one point."""
    reference = closed_form_reference(MODELS["inclusion"].exact, MODELS["inclusion"], run.t, None)
    line = Line("constant steps", (reference.point("h = 0.1", ReferenceRows.of(run), 0.01, 0.1),))
    return Study("A model", "MonotoneInclusion", 2, 1.0, "s", (line,), reference)


def of_units(t):
    return np.exp(-np.asarray(t))[:, None] * np.ones(2)


def small(mu):
    return mu**3


MODELS = {
    "sweeping": SweepingProcess(q=x, f=[1, k], constraints={"disc": ca.norm_2(x) - 1}, q0=[-2, 0.1], t_end=1, step=0.1,
                                parameters={k: None}),
    "first order": FirstOrderSystem(x=x, lam=l, f=[x[1], -k * x[0]], h=x[1], g=[0, l * (1 + x[0] ** 2)], law=relay(1, -k, k),
                                    x0=[1, 0], t_end=1, step=0.1, parameters={k: 2}),
    "lure": LureSystem(A=[[0, 1], [-1, 0]], B=np.eye(2), C=np.eye(2), y=y, phi=ca.norm_inf(y), x0=[1, 2], t_end=1, step=0.1,
                       exact=[t, 0], t=t),
    "inclusion": MonotoneInclusion(x=x, field=-x, phi=0.5 * ca.fabs(x[1]), upper=[0.8, 9], x0=[0, -1], t_end=1, step=0.1,
                                   tolerances=small, exact=of_units),
}  # fmt: skip
LAWS = [
    equality(2),
    complementarity(1),
    relay(2, -k, k),
    box([0, -np.inf], [np.inf, 3]),
    ball(2, k),
    second_order_cone(3),
    polyhedron([[1, 0], [0, 1]], [0, 0]),
    product(relay(1), ball(2)),
]


def case(path):
    """The model of a case, of a crowd written out with fewer people."""
    return nsmodel.load(path, **({"n": 5} if path.stem == "crowd_room" and COUNT < FULL else {}))


def test_every_case_is_the_same_model_afterwards(case_file):
    model = case(case_file)
    if case_file.stem == "inclusion_8_1":  # its exact solution is defined inside a function
        model._set(exact=None)
    assert mark(again(model)) == mark(model)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_a_model_runs_the_same_afterwards(model):
    other, apart = again(model), copy.deepcopy(model)
    values = {name: 2 for name, value in model.parameters.items() if value is None}
    run = simulate(model, parameters=values)
    for one in (other, apart):
        assert type(one) is type(model)
        assert mark(one) == mark(model)
        assert (one.names, dict(one.units), dict(one.parameters)) == (model.names, dict(model.units), dict(model.parameters))
        found = simulate(one, parameters=values)
        for name, array in run.arrays.items():
            np.testing.assert_array_equal(found.arrays[name], array)
        assert found.metadata == run.metadata


def test_symbols_that_are_shared_stay_shared():
    model = again(MODELS["first order"])
    for expression in (model.f, model.h, model.g):
        assert ca.depends_on(expression, model.x)
    assert ca.depends_on(model.f, model.p)
    assert ca.depends_on(model.law.upper, model.p)
    assert not ca.depends_on(model.f, MODELS["first order"].x)
    assert not ca.depends_on(again(model).f, model.x)


def test_a_deep_copy_has_the_symbols_of_the_original_and_arrays_of_its_own():
    model = LureSystem(A=[[-1]], B=1, C=1, law=relay(1), x0=1, steps=[0.1, 0.2], parameters={"k": 1}, units={"t": "s"})
    one, same = copy.deepcopy([model, model])
    assert one is same
    assert one is not model
    assert ca.is_equal(one.x, model.x, 1)
    assert not np.shares_memory(one.steps, model.steps)
    assert dict(one.parameters) == {"k": 1}
    with pytest.raises(TypeError):
        one.units["t"] = "h"


@pytest.mark.parametrize("law", LAWS, ids=lambda law: "-".join(dict.fromkeys(law.labels)))
def test_laws(law):
    for one in (again(law), copy.deepcopy(law)):
        assert [(b.kind, b.label, b.size) for b in one.blocks] == [(b.kind, b.label, b.size) for b in law.blocks]
        np.testing.assert_equal([str(one.lower), str(one.upper)], [str(law.lower), str(law.upper)])
        assert [str(b.data()) for b in one.blocks] == [str(b.data()) for b in law.blocks]
    m = law.size
    one = LureSystem(A=-np.eye(2), B=np.ones((2, m)), C=np.ones((m, 2)), law=again(law), x0=[1, 2], t_end=1, step=0.1,
                     parameters={"k": 1})  # fmt: skip
    assert mark(one) == mark(LureSystem(A=-np.eye(2), B=np.ones((2, m)), C=np.ones((m, 2)), law=law, x0=[1, 2], t_end=1,
                                        step=0.1, parameters={"k": 1}))  # fmt: skip


def test_bodies_items_and_families():
    bodies, sides = Bodies([[0.0, 1.0], [3.0, 1.0]], r=[1.0, 1.0]), Items(normal=[(0, 1)], offset=[0.6])
    i, j, s = bodies.member("i"), bodies.member("j"), sides.member("s")
    pair, side = Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j), Family(ca.dot(s.normal, i.q) + s.offset - i.r, i, s)
    for one in (again(pair), copy.deepcopy(pair)):
        assert one.first.group is one.second.group
        assert ca.depends_on(one.g, one.first.q)
        assert str(one.reach) == str(pair.reach)
    groups, families = again(bodies), again([pair, side])
    np.testing.assert_array_equal(groups.q0, bodies.q0)
    np.testing.assert_array_equal(families[1].second.group.table, sides.table)
    model = ManyBodies(bodies=bodies, f=[1, 0], constraints={"pair": pair, "side": side}, t_end=0.2, step=0.1)
    other = again(model)
    assert mark(other) == mark(model)
    assert all(family.first.group is other.bodies for family in other.constraints.values())
    np.testing.assert_array_equal(simulate(other, compiled=False).x, simulate(model, compiled=False).x)


def test_results():
    model = MODELS["inclusion"]
    run, report = simulate(model), check(model, quick=True)
    measured = measured_from(run)
    cell = Cell({"k": 1.0}, 0.1, 0.01, 1.0, 1.0, "right", {"formula: law": 0.2}, "", 3)
    pushed = Stress("A model", "LureSystem", ("x",), "s", 0.1, (cell,))
    for copied in (again, copy.deepcopy):
        assert copied(report).text() == report.text()
        assert copied(report).document() == report.document()
        assert copied(report).markdown() == report.markdown()
        assert copied(report.findings[0]) == report.findings[0]
        assert copied(measured).document() == measured.document()
        (states, error), (expected, least) = (study.reference.state(run.t) for study in (copied(measured), measured))
        np.testing.assert_array_equal(states, expected)
        assert error == least
        assert copied(pushed).document() == pushed.document()
        assert copied(region_of(model, [run])).text == region_of(model, [run]).text
        other = copied(run)
        assert other.metadata == run.metadata
        np.testing.assert_array_equal(other.x, run.x)


def test_errors_keep_what_was_computed():
    run = simulate(MODELS["inclusion"])
    error = StepError("no", residual=2.0, component="wall")
    error.step, error.time, error.trajectory = 3, 0.3, run
    other = again(error)
    assert (str(other), other.step, other.time, other.residual, other.component) == ("no", 3, 0.3, 2.0, "wall")
    np.testing.assert_array_equal(other.trajectory.x, run.x)
    np.testing.assert_array_equal(again(RunInterrupted(run)).trajectory.x, run.x)
    measured = measured_from(run)
    assert again(StudyInterrupted(measured)).study.document() == measured.document()


def test_a_function_without_a_name_is_refused_by_name():
    model = MonotoneInclusion(x=x, field=-x, x0=[0, -1], t_end=1, step=0.1, tolerances=lambda mu: mu**3)
    with pytest.raises(UsageError, match=r"tolerances: the function .*<lambda> \(.*pickle.py, line \d+\) cannot be .*def"):
        pickle.dumps(model)
    assert copy.deepcopy(model).tolerances(2) == 8

    def exact(t):
        return np.zeros((len(t), 2))

    with pytest.raises(UsageError, match=r"exact: the function .*<locals>.exact \(.*pickle.py, line \d+\) cannot be pickled"):
        pickle.dumps(MonotoneInclusion(x=x, field=-x, x0=[0, 0], t_end=1, step=0.1, exact=exact))


def test_a_pool_of_fresh_processes_takes_models_and_gives_results_back(tmp_path):
    (tmp_path / "neighbour.py").write_text(NEIGHBOUR)
    (tmp_path / "m.py").write_text(textwrap.dedent(FILE))
    by_file, compiled = nsmodel.load(tmp_path / "m.py"), tmp_path / "part"
    first = simulate(MODELS["first order"], t_end=0.5, out=compiled)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        run = pool.submit(simulate, by_file, step=0.05)
        report = pool.submit(check, MODELS["lure"], quick=True)
        resumed = pool.submit(simulate, MODELS["first order"], out=compiled, resume=True)
        refused = pool.submit(simulate, MonotoneInclusion(x=x, field=-x, x0=[0, 0], t_end=1, step=0.1, exact=lambda t: t))
        np.testing.assert_array_equal(run.result().x, simulate(by_file, step=0.05).x)
        assert (
            run.result().metadata["totals"]["largest_error"] == simulate(by_file, step=0.05).metadata["totals"]["largest_error"]
        )
        assert report.result().text() == check(MODELS["lure"], quick=True).text()
        np.testing.assert_array_equal(resumed.result().x, simulate(MODELS["first order"]).x)
        assert len(resumed.result()) > len(first)
        with pytest.raises(UsageError, match="exact: the function"):
            refused.result()


# -- of earlier versions ------------------------------------------------------------------------------------------------


def former(name):
    """A pickle of nothing but a class or function by its name."""
    module, _, name = name.rpartition(".")
    return pickle.loads(f"cnsmodel.{module}\n{name}\n.".encode())


@pytest.mark.parametrize("name", sorted(former_names.CLASSES))
def test_former_classes_are_found(name):
    assert former(name).__name__ == former_names.CLASSES[name]


WITHOUT_NAMES = {name for name in former_names.PACKAGES if name.startswith(("model", "classes"))}  # They had none of their own.


@pytest.mark.parametrize("name", sorted(former_names.MODULES.keys() - WITHOUT_NAMES))
def test_former_modules_are_those_that_have_their_names_now(name):
    now = importlib.import_module(f"nsmodel.{former_names.MODULES[name]}")
    own = next(key for key, value in vars(now).items() if getattr(value, "__module__", "").startswith("nsmodel."))
    assert former(f"{name}.{own}") is vars(now)[own]
    with pytest.raises(AttributeError, match="Can't get attribute 'nothing'"):
        former(f"{name}.nothing")


def test_a_former_module_in_another_takes_no_name_of_it():
    importlib.import_module("nsmodel.laws.box")
    assert former("laws.box") is nsmodel.box
    assert former("laws.box.box") is nsmodel.box


def test_former_errors_are_caught_and_found():
    assert issubclass(nsmodel.errors.BlockError, former("errors.FinalError"))
    assert former("errors.LaterFormatError") is nsmodel.errors.NewerFormatError


def test_a_module_that_never_was_is_not_found():
    with pytest.raises(ModuleNotFoundError, match=r"nsmodel\.stress\.nothing"):
        former("stress.nothing.at_all")


def test_former_modules_do_not_hide_functions():
    importlib.import_module("nsmodel.simulate")
    importlib.import_module("nsmodel.stress")
    assert inspect.isfunction(nsmodel.simulate)
    assert inspect.isfunction(nsmodel.stress)


def test_pickles_of_the_version_before_are_read():
    """A model with a block that holds its input, a run by pieces, and a sweep, with the names that these had."""
    model, run, sweep = (pickle.loads((FIXTURES / f"{name}.pkl").read_bytes()) for name in ("model", "run", "sweep"))
    x, l, u = (ca.SX.sym(name) for name in "xlu")
    same = FirstOrderSystem(
        x=x, lam=l, f=[-x + 2 * u], g=[l], h=[x], law=complementarity(1), x0=[0.0], t_end=3, step=0.01,
        blocks=[hysteresis(u, x, 0.5, 1.0, start=1.0)],
    )  # fmt: skip
    np.testing.assert_array_equal(simulate(model).x, simulate(same).x)
    assert len(run.events) > 0
    assert np.isfinite(run.at(run.t[-1] / 3).x).all()
    assert sweep["end"].values.shape == (3,)


# ---------------------------------------------------------------------------------------------- dataclasses.replace

CASES = [  # Of each class, with what its declaration says in names: law parts, blocks, vectors of states, f beside A.
    "mechanics/belt", "circuits/buck", "mathematics/total_variation", "biology/integrate_and_fire", "biology/repressilator",
    "mathematics/cabot_4_1", "mathematics/moving_disc", "mathematics/leash", "mathematics/inclusion_8_2",
    "mechanics/bouncing_ball", "crowds/crossing",
]  # fmt: skip
NAMES = ("names", "stems", "multiplier_names", "row_names", "input_groups", "parameters", "units", "vectors", "weights")


def whole(model):
    """What a model is in names and, as a hash, in expressions."""
    return {name: str(getattr(model, name, None)) for name in NAMES} | {"hash": fingerprint(model, model_grid(model))}


def model_grid(model):
    return make_grid(model, None, None, None, driven=bool(model.inputs))


@pytest.mark.parametrize("name", CASES)
def test_replace_keeps_names(name):
    model = nsmodel.load(CASES_FOLDER / f"{name}.py")
    other = dataclasses.replace(model, title="of another title")
    assert other.title == "of another title"
    assert whole(other) == whole(model)
    assert whole(dataclasses.replace(other, title="again")) == whole(model)
    for one in (again(model), copy.deepcopy(model), copy.copy(model)):
        assert whole(dataclasses.replace(one, title="again")) == whole(model)


def replaced(model):
    """What `dataclasses.replace` makes of a model, or the kind of its refusal."""
    try:
        return whole(dataclasses.replace(model, title="again"))
    except nsmodel.errors.NsmodelError as error:
        return type(error)


def test_replace_of_a_copy_is_that_of_a_bound_model(case_file):
    """Numbers that were put in place of parameters stay."""
    model = case(case_file)
    if case_file.stem == "inclusion_8_1":  # its exact solution is defined inside a function
        model = dataclasses.replace(model, exact=None)
    bound = model.bind({name: 1.25 * (value or 1.0) for name, value in model.parameters.items()})
    assert replaced(again(bound)) == replaced(copy.deepcopy(bound)) == replaced(bound)
    assert replaced(model) != replaced(bound) or not model.parameters


def test_what_was_given_and_cannot_be_pickled_is_left_out():
    x = ca.SX.sym("x")
    for given in (Unpicklable([1.0]), OfThisProcess([1.0])):
        model = LureSystem(x=x, A=[[-1]], B=[[1]], C=[[1]], law=relay(1), x0=given, t_end=1, step=0.1)
        other = again(model)
        assert mark(other) == mark(model)
        assert b"OfThisProcess" not in pickle.dumps(model)
        assert dataclasses.replace(other, title="new").title == "new"


class Unpicklable(list):
    def __reduce_ex__(self, protocol):
        raise ValueError("it is not written")


class OfThisProcess(list):
    pass


def test_every_class_is_replaced():
    kinds = {type(nsmodel.load(CASES_FOLDER / f"{name}.py")).__name__ for name in CASES}
    assert kinds == set(MODEL_CLASSES)


def test_what_is_replaced_is_read_anew():
    law, units = {"friction": relay(1)}, {"friction": "N"}
    model = LureSystem(A=[[-1]], B=[[1]], C=[[1]], law=law, x0=[1], t_end=1, step=0.1, units=units)
    other = dataclasses.replace(model, x0=[2], A=-2 * model.x)
    assert other.multiplier_names == ("friction",)
    assert simulate(other).friction[1] == -1.0
    assert simulate(other).x[1, 0] == pytest.approx((2 - 0.1) / 1.2, rel=1e-12)
    assert dataclasses.replace(model, law=model.law).multiplier_names == ("friction",)
    assert dataclasses.replace(model, law=relay(1), units={}).multiplier_names == ("l_0",)
    with pytest.raises(nsmodel.ModelError, match="units: 'friction' is not a state"):
        dataclasses.replace(model, law=relay(1))


def test_a_copy_is_replaced_as_the_model():
    copied = copy.copy(LureSystem(A=[[-1]], B=[[1]], C=[[1]], law={"friction": relay(1)}, x0=[1], t_end=1, step=0.1))
    gc.collect()
    assert dataclasses.replace(copied, x0=[2]).multiplier_names == ("friction",)
    assert not {"_declaration"} & {*vars(copied)}
