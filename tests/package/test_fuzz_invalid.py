"""Random nonsense in place of arguments: a clear error of nsmodel that names what is wrong, and nothing else."""

from __future__ import annotations

import datetime
import fractions
from collections.abc import Callable
from decimal import Decimal
from typing import Any

import casadi as ca
import numpy as np
import sympy
from fuzz_models import repeatable, share
from hypothesis import given
from hypothesis import strategies as st

from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MonotoneInclusion,
    NsmodelError,
    SweepingProcess,
    ball,
    box,
    complementarity,
    equality,
    polyhedron,
    product,
    relay,
    second_order_cone,
    simulate,
)

nan, inf = float("nan"), float("inf")
t, q, x, s, lam, y = (ca.SX.sym(name, size) for name, size in (("t", 1), ("q", 2), ("x", 2), ("s", 1), ("l", 1), ("y", 1)))

GRID = {"t_end": 0.3, "step": 0.1}
COMMON = {"parameters": {"k": 2.0}, "names": None, "units": {}, "exact": None, "title": "", "steps": None, "t": t}
VALID: dict[type, dict[str, Any]] = {
    SweepingProcess: {
        "q": q, "f": [1, 0], "constraints": {"disc": ca.norm_2(q) - 1}, "q0": [-2, 0.1], "mean_forcing": False, "scene": None,
    },
    FrictionOscillator: {
        "x": x, "potential": ca.sumsqr(x) / 2, "friction": {"rub": ([1, 0], 0.1 * s)}, "s": s, "damping": None,
        "constraints": {"wall": x[0] + 3}, "x0": [1, 0], "v0": None, "x1": None,
    },
    FirstOrderSystem: {
        "x": x, "lam": lam, "f": [x[1], 0], "h": x[1], "g": [0, lam], "M": None, "law": relay(1), "x0": [1, 0], "lam0": None,
        "theta": 1.0, "gamma": 1.0,
    },
    LureSystem: {
        "x": x, "A": [[0, 1], [-1, 0]], "B": [0, 1], "C": [0, 1], "D": None, "f": None, "law": relay(1), "phi": None, "y": y,
        "x0": [1, 0], "theta": 1.0, "gamma": 1.0,
    },
    MonotoneInclusion: {
        "x": x, "field": -x, "operator": ca.sign(x), "phi": None, "lower": -1, "upper": 2, "constraints": None, "x0": [1, 0],
        "tolerances": None,
    },
}  # fmt: skip
OPTIONS = {"step": 0.1, "steps": None, "t_end": 0.3, "parameters": None, "solver": "auto", "tolerance": 1e-9, "save_every": 1}
LAWS: list[tuple[Callable[..., Any], dict[str, Any]]] = [
    (equality, {"m": 1}), (complementarity, {"m": 1}), (relay, {"m": 1, "lower": -1, "upper": 1}),
    (box, {"lower": -1, "upper": 1}), (ball, {"m": 2, "radius": 1.0}), (second_order_cone, {"m": 2}),
    (polyhedron, {"H": [[1.0]], "K": [-1.0]}),
]  # fmt: skip


def broken(*_: Any) -> float:
    raise RuntimeError("a function that fails")


NONSENSE = [
    None, True, False, nan, inf, -inf, 0, -1, 3, 2.5, -0.0, 10**400, 1j, "", "q", "x_0", "1", "auto", b"x", ..., object(),
    int, broken, fractions.Fraction(1, 3), Decimal("1.5"), datetime.date(2000, 1, 1), np.float32(1.5), np.int8(-3),
    np.datetime64("2000-01-01"), np.complex128(1j), np.bool_(True), {}, {"k": 1}, {"disc": None}, {1: 2}, {"k": nan},
    {"k": "2"}, {"wall": q[0] >= 0}, set(), {1, 2}, range(2), [], (), [[]], [None], ["a", "b"], [1, [2]], [[1, 2], [3]],
    [nan, 0], [1, inf], [1, 2, 3], [[1, 2], [3, 4], [5, 6]], np.zeros(0), np.zeros((0, 2)), np.zeros((2, 2, 2)),
    np.zeros((3, 3)), np.array(["a", "b"]), np.array([None, 1]), np.array(5), np.array([1j, 0]),
    np.ma.masked_array([1.0, 2.0], [True, False]), np.array([(1, 2)], "i,i"), ca.DM(2, 2), ca.DM.nan(2), ca.DM.inf(2),
    ca.SX(), ca.SX(2, 1), ca.SX.nan(2), ca.SX.sym("strange"), ca.SX.sym("strange", 2), ca.SX.sym("x", 2, 2), 2 * q,
    ca.sqrt(-1 - x**2), 1 / x[0] - 1 / x[0], ca.MX.sym("m"), ca.MX.sym("x", 2), ca.MX.sym("q", 2) ** 2, ca.MX(2, 2),
    ca.Sparsity.dense(2), ca.sin, ca.Function("F", [q], [2 * q]), sympy.Symbol("x_0"), sympy.Symbol("strange"),
    sympy.Function("u")(sympy.Symbol("x_0")), sympy.zoo, sympy.nan, sympy.I, sympy.oo, sympy.Matrix([[1, 2], [3, 4]]),
    sympy.Symbol("x_0") < 1, relay, relay(3), product(), equality(2), second_order_cone(3), ball(2),
    polyhedron([[1.0, 0.0]], [0.0]), -ca.norm_2(x), -ca.sumsqr(x), ca.fabs(x[0]) * ca.fabs(x[1]), ca.floor(x),
    ca.sign(ca.sign(x)), s**2 - s, -s, ca.if_else(x[0] > 0, 1, 2), ca.logic_and(x[0] > 0, x[1] > 0),
]  # fmt: skip
nonsense = st.recursive(
    st.integers(0, len(NONSENSE) - 1).map(lambda i: NONSENSE[i]),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.tuples(inner, inner)
        | st.dictionaries(st.sampled_from(["k", "disc", "t"]), inner, max_size=2)
    ),
    max_leaves=4,
)


@st.composite
def wrong_calls(draw: Callable[[Any], Any]) -> tuple[type, dict[str, Any], dict[str, Any]]:
    """A class, its arguments, those of the run; one or two of them are nonsense."""
    kind = draw(st.sampled_from(list(VALID)))
    arguments, options = {**GRID, **VALID[kind]}, {}
    names = draw(
        st.lists(
            st.sampled_from([*arguments, *COMMON, *(f"run {name}" for name in OPTIONS)]), min_size=1, max_size=2, unique=True
        )
    )
    for name in names:
        if name.startswith("run "):
            options[name[4:]] = draw(nonsense)
        else:
            arguments[name] = draw(nonsense)
    return kind, arguments, options


def refused(action: Callable[[], Any]) -> str | None:
    """The message of an error of nsmodel; None where there is nothing to refuse."""
    try:
        action()
    except NsmodelError as error:
        return str(error)
    return None


@repeatable(share(500, 125))
@given(call=wrong_calls())
def wrong_models(call: tuple[type, dict[str, Any], dict[str, Any]]) -> None:
    kind, arguments, options = call
    said = refused(lambda: simulate(kind(**arguments), **options))
    if said is not None:
        assert len(said) < 1500
        assert any(name in said for name in [*arguments, *options, "constraint", "parameter", "symbol"]), said


@repeatable(share(200, 50))
@given(data=st.data())
def wrong_laws(data: Any) -> None:
    make, arguments = data.draw(st.sampled_from(LAWS))
    given = dict(arguments)
    given[data.draw(st.sampled_from(list(given)))] = data.draw(nonsense)
    said = refused(lambda: make(**given))
    if said is not None:
        assert make.__name__ in said or "cone" in said, said


def test_nonsense_is_refused_in_words(capfd):
    wrong_models()
    assert capfd.readouterr() == ("", "")


def test_nonsense_in_laws_is_refused_in_words(capfd):
    wrong_laws()
    assert capfd.readouterr() == ("", "")


# ---------------------------------------------------------------------------------------------- mistakes that have a name

words = st.text("abcdefgh", min_size=3, max_size=6).map(lambda text: f"{text}_")  # no name that is taken
sizes = st.integers(1, 5)


def pick(draw: Callable[[Any], Any], values: Any) -> Any:
    """One of the values, hashable or not."""
    return values[draw(st.integers(0, len(values) - 1))]


@st.composite
def systems(draw: Callable[[Any], Any]) -> tuple[Callable[..., Any], dict[str, tuple[int, ...]], dict[str, Any]]:
    """(class, {argument: its shape}, valid arguments) with n states and m multipliers."""
    n, m = draw(st.integers(2, 4)), draw(st.integers(2, 3))
    z, l = ca.SX.sym("z", n), ca.SX.sym("l", m)
    one, vector = np.eye(n), {"f": (n,), "x0": (n,)}
    lure = {
        "A": -one,
        "B": one[:, :m],
        "C": one[:m] if m <= n else np.ones((m, n)),
        "law": relay(m),
        "f": np.zeros(n),
        "x0": np.ones(n),
    }
    lure["B"] = np.array(lure["C"]).T
    kinds = {
        LureSystem: (vector | {"A": (n, n), "B": (n, m), "C": (m, n), "D": (m, m)}, lure | {"D": np.eye(m)}),
        FirstOrderSystem: (
            vector | {"M": (n, n), "g": (n,), "h": (m,), "lam0": (m,)},
            {"x": z, "lam": l, "f": np.zeros(n), "h": ca.vertcat(*[z[0]] * m), "g": np.zeros(n), "M": one, "law": relay(m),
             "x0": np.ones(n), "lam0": np.zeros(m)},
        ),
        SweepingProcess: ({"f": (n,), "q0": (n,)}, {"q": z, "f": np.zeros(n), "q0": np.ones(n), "constraints": {"wall": z[0]}}),
        FrictionOscillator: (
            {"x0": (n,), "v0": (n,), "damping": (n, n)},
            {"x": z, "potential": ca.sumsqr(z), "friction": s, "s": s, "x0": np.ones(n), "v0": np.zeros(n), "damping": one},
        ),
        MonotoneInclusion: (
            {"field": (n,), "operator": (n,), "x0": (n,), "lower": (n,), "upper": (n,)},
            {"x": z, "field": np.zeros(n), "operator": np.zeros(n), "x0": np.ones(n), "lower": np.zeros(n),
             "upper": 2 * np.ones(n)},
        ),
    }  # fmt: skip
    kind = pick(draw, (list(kinds)))
    shapes, arguments = kinds[kind]
    return kind, shapes, arguments | GRID


def entry(array: Any, shape: tuple[int, ...], at: tuple[int, ...], value: Any) -> list[Any]:
    """Nested lists of the array with one entry replaced."""
    listed = np.array(array, object).reshape(shape)
    listed[at] = value
    return listed.tolist()


@st.composite
def mistakes(draw: Callable[[Any], Any]) -> tuple[Callable[[], Any], list[str]]:
    """A call that must be refused, and the words that the message must hold."""
    kind, shapes, arguments = draw(systems())
    numeric = {name: shape for name, shape in shapes.items() if name != "h"}
    name = pick(draw, (list(numeric)))
    shape, word = shapes[name], draw(words)
    at = tuple(draw(st.integers(0, size - 1)) for size in shape)
    place = f"{name}[{', '.join(map(str, at))}]"
    start = "q0" if kind is SweepingProcess else "x0"
    state = "z" if kind is not LureSystem else "x"

    def declared(**other: Any) -> Callable[[], Any]:
        return lambda: kind(**(arguments | other))

    def run(model: dict[str, Any] | None = None, **options: Any) -> Callable[[], Any]:
        return lambda: simulate(kind(**(arguments | (model or {}))), **options)

    def longer() -> tuple[Callable[[], Any], list[str]]:
        more = tuple(size + draw(st.integers(1, 2)) for size in shape)
        return declared(**{name: np.ones(more)}), [] if name == "x0" else [name, str(more[0])]

    def hollow() -> tuple[Callable[[], Any], list[str]]:
        return declared(**{name: entry(arguments[name], shape, at, nan)}), [place, "NaN"]

    def infinite() -> tuple[Callable[[], Any], list[str]]:
        value = pick(draw, ([inf, -inf]))
        if name in ("lower", "upper"):
            value = inf if name == "lower" else -inf
        return declared(**{name: entry(arguments[name], shape, at, value)}), [place, "inf"]

    def undeclared() -> tuple[Callable[[], Any], list[str]]:
        return declared(**{name: entry(arguments[name], shape, at, ca.SX.sym(word))}), [name, f"'{word}'"]

    def text() -> tuple[Callable[[], Any], list[str]]:
        return declared(**{name: entry(arguments[name], shape, at, word)}), [name, word, "str"]

    def repeated() -> tuple[Callable[[], Any], list[str]]:
        n = shapes[start][0]
        return declared(names=[word] * n), ["names", word]

    def no_value() -> tuple[Callable[[], Any], list[str]]:
        return run({"parameters": {word: None}}), [f"'{word}'", "no value"]

    def unknown_parameter() -> tuple[Callable[[], Any], list[str]]:
        return run(parameters={word: 1.0}), [f"'{word}'", "not declared"]

    def parameter() -> tuple[Callable[[], Any], list[str]]:
        value = pick(draw, ([nan, inf, "1", True, 1j, [1, 2], ca.SX.sym("a")]))
        return run({"parameters": {word: 1.0}}, parameters={word: value}), [f"'{word}'"]

    def step() -> tuple[Callable[[], Any], list[str]]:
        option, value = pick(draw, (["step", "t_end"])), pick(draw, ([0, -0.1, nan, inf, "1", True, [0.1], 1j]))
        return pick(draw, ([declared(**{option: value}), run(**{option: value})])), [option]

    def steps() -> tuple[Callable[[], Any], list[str]]:
        count = draw(sizes)
        i = draw(st.integers(0, count - 1))
        given = [0.1] * count
        given[i] = pick(draw, ([0, -0.1, nan, inf]))
        return pick(draw, ([declared(steps=given, step=None, t_end=None), run(steps=given)])), [f"steps[{i}]"]

    def option() -> tuple[Callable[[], Any], list[str]]:
        which, value = pick(draw, ([
            ("solver", word), ("solver", 5), ("tolerance", -1), ("tolerance", nan), ("tolerance", "small"), ("save_every", 0),
            ("save_every", 1.5), ("save_every", "all"), ("compiled", "yes"), ("parameters", [1]),
        ]))  # fmt: skip
        return run(**{which: value}), [which]

    def crossed() -> tuple[Callable[[], Any], list[str]]:
        m = draw(sizes)
        i = draw(st.integers(0, m - 1))
        lower, upper = np.zeros(m), np.ones(m)
        lower[i] = draw(st.floats(1.5, 1e300))
        make = pick(draw, ([lambda: relay(m, lower, upper), lambda: box(lower, upper)]))
        return make, [f"lower[{i}]"]

    def law_size() -> tuple[Callable[[], Any], list[str]]:
        size = draw(st.integers(4, 6))
        given = {"law": pick(draw, ([relay(size), product(relay(2), ball(size - 2)), second_order_cone(size)]))}
        if kind not in (LureSystem, FirstOrderSystem):
            return lambda: MonotoneInclusion(**(VALID[MonotoneInclusion] | GRID | {"operator": given["law"]})), ["operator", "2"]
        return declared(**given), [str(size), "law"]

    def outside() -> tuple[Callable[[], Any], list[str]]:
        if kind in (LureSystem, FirstOrderSystem):
            return repeated()
        first = arguments[draw(st.just("q" if kind is SweepingProcess else "x"))][0]
        far = draw(st.floats(1e-3, 1e6))
        return run({"constraints": {word: first - 1 - far}}), [f"'{word}'", "outside", start]

    def undefined() -> tuple[Callable[[], Any], list[str]]:
        """Not a number where the run starts (every state is 1 there)."""
        first = ca.SX.sym("z", 2)[0] if kind is LureSystem else ca.SX.sym(f"{state}", shapes[start][0])[0]
        n = shapes[start][0]
        value = pick(draw, ([ca.sqrt(first - 2), ca.log(first - 1), 1 / (first - 1), (first - 2) ** 0.5]))
        rate = {
            LureSystem: "A",
            FirstOrderSystem: "f",
            SweepingProcess: "f",
            MonotoneInclusion: "field",
            FrictionOscillator: "potential",
        }
        given: dict[str, Any] = {rate[kind]: value if kind is FrictionOscillator else [value, *[0] * (n - 1)]}
        if kind is LureSystem:
            given["x"] = ca.SX.sym("z", n)
        return run(given), ["finite"]

    def concave() -> tuple[Callable[[], Any], list[str]]:
        weight, at_state = draw(st.floats(1e-3, 1e3)), ca.SX.sym("z", 2)
        term = pick(draw, ([ca.fabs(at_state[0]), ca.norm_2(at_state), ca.fmax(at_state[0], at_state[1])]))
        bad = {"x": at_state, "x0": [1, 0], **GRID}
        return pick(draw, ([
            lambda: FrictionOscillator(potential=ca.sumsqr(at_state) - weight * term, **bad),
            lambda: MonotoneInclusion(field=[0, 0], phi=-weight * term, **bad),
        ])), ["not convex"]  # fmt: skip

    def no_inertia() -> tuple[Callable[[], Any], list[str]]:
        n = shapes[start][0]
        given = {"M": np.zeros((n, n)), "f": np.zeros(n)}
        z = ca.SX.sym("z", n)
        return lambda: simulate(FirstOrderSystem(x=z, **given, x0=np.ones(n), **GRID)), ["singular", "M"]

    every = (
        longer, hollow, infinite, undeclared, text, repeated, no_value, unknown_parameter, parameter, step, steps, option,
        crossed, law_size, outside, undefined, concave, no_inertia,
    )  # fmt: skip
    return pick(draw, (every))()


@repeatable(share(500, 125))
@given(mistake=mistakes())
def named_mistakes(mistake: tuple[Callable[[], Any], list[str]]) -> None:
    action, expected = mistake
    said = refused(action)
    assert said is not None, f"nothing was refused; expected {expected}"
    assert all(word in said for word in expected), f"{said!r} does not say {expected}"


def test_a_mistake_is_named(capfd):
    named_mistakes()
    assert capfd.readouterr() == ("", "")
