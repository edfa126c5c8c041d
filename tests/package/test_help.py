"""What users read at a prompt: reprs of a few short lines, and help that names all arguments."""

import ast
import dataclasses
import inspect
import re
import textwrap
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel import _utils
from nsmodel.modeling.model_files import all_cases

PUBLIC = [(name, getattr(nsmodel, name)) for name in nsmodel.__all__]
CLASSES = [(name, value) for name, value in PUBLIC if inspect.isclass(value) and not issubclass(value, BaseException)]


def short(shown):
    """The lines of a repr; at most ten of 100 columns, none of them with an address or a whole array."""
    lines = repr(shown).splitlines()
    assert 0 < len(lines) <= 10
    assert max(map(len, lines)) <= 100
    assert not re.search(r"at 0x|array\(|mappingproxy", repr(shown)), repr(shown)
    return lines


# -- reprs -------------------------------------------------------------------------------------------------------------


def test_the_repr_of_a_model_names_what_it_has(load_case):
    assert short(load_case("diode_bridge")) == [
        "LureSystem: Diode bridge rectifier",
        "  states      2: v_C [V], i_L [A]",
        "  multipliers 4: l_0 [V], l_1 [V], l_2 [A], l_3 [A]",
        "  law         complementarity 4",
        "  time        0 to 0.005 s, step 1e-06 s, scheme theta-gamma",
    ]
    assert "  blocks      PI, every 0.05" in short(load_case("sampled_pi"))
    x = ca.SX.sym("x", 60)
    model = nsmodel.SweepingProcess(q=x, f=-x, constraints={}, q0=np.zeros(60), t_end=1, step=1)
    assert short(model)[1] == f"  states      60: {', '.join(f'x_{i}' for i in range(13))}, ... 47 more"


def test_public_objects_are_a_few_lines(load_case, run_case):
    model, crowd, run = load_case("diode_bridge"), load_case("crowd"), run_case("sliding_relay")
    a, b = ca.SX.sym("a", 40), ca.SX.sym("b")
    pair = next(iter(crowd.constraints.values()))
    made = [
        nsmodel.product(*[nsmodel.relay(2), nsmodel.ball(3, b)] * 400), nsmodel.polyhedron(np.eye(30), np.ones(30)),
        nsmodel.ellipsoid(np.eye(20)), nsmodel.second_order_cone(30), nsmodel.box(-a, a), nsmodel.table(range(999), range(999)),
        nsmodel.pwm(1.0, 0.5), nsmodel.steps(np.zeros((500, 3))), nsmodel.within([0] * 50, [1] * 50), nsmodel.signal(np.sin),
        nsmodel.hysteresis(b, ca.sum1(a**2), 0, 1, start=1), crowd.bodies, pair, pair.first, crowd, run, run.at(run.t),
        run.spectrum(run.metadata["state_names"][0]), nsmodel.stepper(model), *all_cases()[:3], run.at(0.5),
    ]  # fmt: skip
    for one in made:
        short(one)
        for block in getattr(one, "blocks", ()):
            short(block)
    assert short(made[0])[0].startswith("Law(relay 2, ball 3, relay 2, ball 3, ")
    assert short(made[2]) == ["Law(ellipsoid 20)"]
    assert short(nsmodel.product(nsmodel.relay(2), nsmodel.relay(3))) == ["Law(relay 5)"]
    assert short(nsmodel.stepper(model)) == ["ModelStepper('Diode bridge rectifier', t = 0, 0 steps of 1e-06, x = [10, 0])"]


def test_results_are_a_few_lines(load_case, run_case):
    from nsmodel.study import Line, Point, Study
    from nsmodel.study.stress import Cell, Stress

    model, run = load_case("sliding_relay"), run_case("sliding_relay")
    report = nsmodel.check(model, runs=[run], quick=True)
    for one in (report, *report.findings, *report.consequences):
        short(one)
    assert short(report)[0].startswith("Report('Sliding relay', LureSystem: ")
    line = Line("implicit", tuple(Point(f"h = {k}", 1.0, {"max": 1.0}) for k in range(100)))
    study = Study("A", "LureSystem", 2, 1.0, "s", (line,) * 50, None)
    assert short(study) == ["Study('A', LureSystem: 50 lines, 5000 points, done)"]
    for one in (line, line.points[0]):
        short(one)
    cells = tuple(Cell({"k": k}, 1.0, 0.1, 1.0, 1.0, "right", {}, "", 3) for k in range(500))
    assert short(Stress("A", "LureSystem", ("x",), "", 0.1, cells)) == [
        "Stress('A', LureSystem: 500 cells, 500 right, 0 stopped, 0 wrong)"
    ]
    short(cells[0])
    sweep = nsmodel.sweep(
        load_case("cabot_4_1"), grid={"alpha": [0.01, 0.02]}, outputs={"last": "x[-1]"}, workers=1, compiled=False
    )
    for one in (sweep, sweep["last"], nsmodel.statistics(sweep["last"]), nsmodel.share(sweep["last"] > 0)):
        short(one)


def test_values_are_cut_and_named():
    made = SimpleNamespace(a="x\n" * 200, b=np.arange(3.0), c={k: k for k in range(9)}, d=None, e=(), f=ca.SX.sym("s", 40), g=abs)
    long = f"'{'x ' * 27}...'"
    assert " ".join(_utils.short_repr(made).split()) == (
        f"SimpleNamespace(a={long}, b=[0, 1, 2], c={{0: 0, 1: 1, 2: 2, 3: 3, ... 9 in all}}, f=SX 40 x 1, g=abs)"
    )
    assert _utils.join_within_width(["one", "two", "three"], 15) == "one, two, three"
    assert _utils.join_within_width(["one", "two", "three"], 14) == "... 3 more"
    assert len(_utils.wrap_lines("word " * 2000)) == 10


# -- help --------------------------------------------------------------------------------------------------------------


def parameters(function):
    try:
        found = inspect.signature(function).parameters
    except (TypeError, ValueError):
        return []
    return [name for name in found if name not in ("self", "cls") and not name.startswith("_")]


def names(doc, word):
    return re.search(rf"(?<!\w){re.escape(word)}(?!\w)", doc)


def raised(function):
    """The errors that stand in its own code."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    calls = [node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call)]
    return {call.func.id for call in calls if isinstance(call.func, ast.Name)} - {"NotImplementedError"}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, value in PUBLIC if inspect.isfunction(value)])
def test_help_of_a_function_names_its_arguments_and_errors(name, value):
    doc = inspect.getdoc(value)
    assert [one for one in parameters(value) if not names(doc, one)] == []
    assert [error for error in raised(value) if error not in doc] == []


@pytest.mark.parametrize(("name", "value"), CLASSES)
def test_help_of_a_class_names_its_fields_and_what_its_methods_take(name, value):
    doc = inspect.getdoc(value)
    assert [one for one in parameters(value) if not names(doc, one)] == []
    for label, member in vars(value).items():
        function = getattr(member, "__func__", getattr(member, "fget", member))
        if not label.startswith("_") and inspect.isfunction(function):
            own = inspect.getdoc(getattr(value, label))
            assert [one for one in parameters(function) if not names(own, one)] == [], label
            assert [error for error in raised(function) if error not in own] == [], label


def test_signatures_of_models_begin_with_their_own_arguments():
    shown = list(inspect.signature(nsmodel.LureSystem).parameters)
    assert shown[:4] == ["x", "A", "B", "C"]
    assert set(shown) == {field.name for field in dataclasses.fields(nsmodel.LureSystem) if field.init}
    assert "factory" not in str(inspect.signature(nsmodel.ManyBodies))
    doc = inspect.getdoc(nsmodel.ManyBodies)
    assert doc.index("bodies: ") < doc.index("t_end: ") < doc.index("Raises:")
    assert doc.count("Attributes:") == 1
