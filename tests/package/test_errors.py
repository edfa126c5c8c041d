"""Wrong models and wrong runs: each message names what is wrong in the user's words, the value or shape, and the fix."""

import re
import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import scipy.sparse
import sympy

import nsmodel
from nsmodel import (
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    ModelError,
    MonotoneInclusion,
    StepError,
    StorageError,
    SweepingProcess,
    UsageError,
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
from nsmodel.modeling.parameters import RESERVED_RUN_NAMES
from nsmodel.solvers import catching_up

nan, inf = float("nan"), float("inf")
t, q, x, s, lam, y, k = (
    ca.SX.sym(name, size) for name, size in (("t", 1), ("q", 2), ("x", 2), ("s", 1), ("l", 1), ("y", 1), ("k", 1))
)


def lure(**other):
    given = {"A": [[0, 1], [-1, 0]], "B": [0, 1], "C": [0, 1], "law": relay(1), "x0": [1, 0], "t_end": 1, "step": 0.1}
    return LureSystem(**(given | other))


def lure_2(**other):
    """Return a system of three states and a law of two components."""
    given = {"A": np.eye(3), "B": np.ones((3, 2)), "C": np.ones((2, 3)), "law": relay(2), "x0": [1, 0, 2]}
    return lure(**(given | other))


def lure_phi(phi, **other):
    return lure(law=None, phi=phi, **({"y": y} | other))


def sweeping(**other):
    disc = ca.norm_2(q) - 1
    given = {"t": t, "q": q, "f": [1, 0], "constraints": {"disc": disc}, "q0": [-2, 0.1], "t_end": 1, "step": 0.1}
    return SweepingProcess(**(given | other))


def oscillator(**other):
    given = {"x": x, "potential": ca.sumsqr(x) / 2, "friction": 0.1 * s, "s": s, "x0": [1, 0], "t_end": 1, "step": 0.1}
    return FrictionOscillator(**(given | other))


def first_order(**other):
    given = {"x": x, "lam": lam, "f": [x[1], 0], "h": x[1], "g": [0, lam], "law": relay(1), "x0": [1, 0], "t_end": 1, "step": 0.1}
    return FirstOrderSystem(**(given | other))


def inclusion(**other):
    given = {"x": x, "field": -x, "operator": ca.sign(x), "lower": -1, "upper": 2, "x0": [1, 0], "t_end": 1, "step": 0.1}
    return MonotoneInclusion(**(given | other))


def mx_that_does_not_expand():
    value = ca.MX.sym("q", 2)
    return ca.solve(ca.vertcat(ca.horzcat(1, value[0]), ca.horzcat(value[1], 2)), value)


# What is wrong: (builder, what is given, what the message says). Each is refused when the model is declared.
SHAPES = [
    (
        lure,
        {"A": [[0, 1], [1, 0], [0, 0]]},
        "A: shape (3, 2); expected (2, 2), a row and a column for each of 2 states x_0, x_1; or give",
    ),
    (lure, {"A": [1, 2, 3]}, "A: shape (3, 1); expected (2, 2)"),
    (lure, {"A": [0, 1]}, "A: shape (2, 1); expected (2, 2)"),
    (lure, {"A": 5}, "A: shape (1, 1); expected (2, 2)"),
    (lure, {"A": [[1, 2], [3]]}, "A: the rows have 2, 1 entries; expected rows of one length"),
    (lure, {"A": np.zeros((2, 2, 2))}, "A: shape (2, 2, 2); expected a scalar, a vector or a matrix"),
    (
        lure,
        {"x": x, "A": [[x[0], 0], [0, 1]]},
        "A: a matrix (2, 2) with entries of x; write the product with x, as 2 expressions",
    ),
    (lure, {"x": x, "A": [x[0], 0, 1]}, "A: shape (3, 1); expected a column of 2 entries"),
    (
        lure_2,
        {"B": np.ones((2, 3))},
        "B: shape (2, 3); expected (3, 2), a row for each of 3 states, a column for each of 2 components of the",
    ),
    (lure_2, {"B": np.ones((2, 3))}, "it seems to be transposed"),
    (
        lure_2,
        {"C": np.ones((3, 2))},
        "C: shape (3, 2); expected (2, 3), a row for each of 2 components of the law, a column for each of 3 states; it",
    ),
    (lure_2, {"D": np.ones((2, 3))}, "D: shape (2, 3); expected (2, 2), a row and a column for each of 2 components of the law"),
    (lure_2, {"D": [1, 2]}, "D: shape (2, 1); expected (2, 2)"),
    (lure_2, {"B": [1, 2, 3]}, "B: shape (3, 1); expected (3, 2)"),
    (
        lure,
        {"law": relay(2)},
        "B: shape (2, 1); expected (2, 2), a row for each of 2 states, a column for each of 2 components of the law",
    ),
    (
        lure,
        {"law": None, "phi": ca.fabs(y), "y": ca.SX.sym("y", 2)},
        "B: shape (2, 1); expected (2, 2), a row for each of 2 states, a column for each of 2 symbols of y",
    ),
    (lure, {"f": [0, 1, 2]}, "f: shape (3, 1); expected a column of 2 entries"),
    (lure, {"f": 5}, "f: shape (1, 1); expected a column of 2 entries"),
    (lure, {"x0": [1, 0, 0]}, "x0: 3 numbers; expected 2, one for each state, as A has the shape (2, 2)"),
    (lure, {"x0": np.eye(2)}, "x0: shape (2, 2); expected a column, one number for each state"),
    (lure, {"x0": []}, "x0: shape (0, 1); expected a column, one number for each state"),
    (lure, {"x": x, "x0": [1]}, "x0: shape (1, 1); expected a column of 2 entries"),
    (lure_phi, {"phi": [ca.fabs(y), 1]}, "phi: shape (2, 1); expected one scalar expression"),
    (sweeping, {"q0": [1, 2, 3]}, "q0: shape (3, 1); expected a column of 2 entries"),
    (sweeping, {"f": [1]}, "f: shape (1, 1); expected a column of 2 entries"),
    (oscillator, {"potential": x}, "potential: shape (2, 1); expected one scalar expression"),
    (oscillator, {"damping": np.eye(3)}, "damping: shape (3, 3); expected (2, 2), as there are 2 states"),
    (
        oscillator,
        {"friction": {"floor": (np.eye(3), 0.1 * s)}},
        "friction 'floor': H has shape (3, 3); expected (m, 2), one column for each state",
    ),
    (oscillator, {"friction": {"floor": (np.zeros((0, 2)), s)}}, "friction 'floor': H has shape (0, 2); expected (m, 2)"),
    (oscillator, {"v0": [1]}, "v0: shape (1, 1); expected a column of 2 entries"),
    (oscillator, {"x1": [1]}, "x1: shape (1, 1); expected a column of 2 entries"),
    (first_order, {"M": [1, 2]}, "M: shape (2, 1); expected (2, 2), as there are 2 states"),
    (first_order, {"h": [1, 2]}, "h: shape (2, 1); expected one scalar expression"),
    (first_order, {"g": [lam]}, "g: shape (1, 1); expected a column of 2 entries"),
    (first_order, {"lam0": [1, 2]}, "lam0: shape (2, 1); expected one scalar expression"),
    (first_order, {"law": relay(2)}, "law: it has 2 components, but lam = l has 1; make them equal"),
    (inclusion, {"field": [1]}, "field: shape (1, 1); expected a column of 2 entries"),
    (inclusion, {"lower": [0, 0, 0]}, "lower: shape (3, 1); expected a column of 2 entries"),
    (
        inclusion,
        {"operator": relay(1)},
        "operator: a law of size 2 made of boxes is expected; for other convex potentials use phi=",
    ),
]

SYMBOLS = [
    (
        lure,
        {"A": [[k, 0], [0, 1]]},
        "A uses the symbol 'k', which is not declared: add it to parameters={...}, to inputs={...} if it is a signal, or "
        "declare it as x=, t=; declared are x_0, x_1",
    ),
    (lure, {"B": [0, k]}, "B uses the symbol 'k', which is not declared"),
    (lure, {"f": [t, 0]}, "f uses the symbol 't', which is not declared"),
    (lure, {"x0": [k, 0]}, "x0 uses the symbol 'k', which is not declared: add it to parameters={...}"),
    (lure, {"law": relay(1, -k, k)}, "law: lower uses the symbol 'k', which is not declared: add it to parameters={...}"),
    (
        lure,
        {"t": t, "law": relay(1, -1, ca.SX.sym("x_0"))},
        "law: upper depends on 'x_0', but may depend only on t; move that term elsewhere",
    ),
    (lure, {"t": t, "A": [[t, 0], [0, 1]]}, "A depends on 't', but may depend only on numbers"),
    (lure, {"t": t, "D": t}, "D depends on 't', but may depend only on numbers"),
    (lure, {"f": [0, ca.SX.sym("x_0")]}, "f depends on 'x_0', but may depend only on t"),
    (lure_phi, {"phi": k * ca.fabs(y)}, "phi uses the symbol 'k', which is not declared"),
    (lure, {"exact": [t, k], "t": t}, "exact uses the symbol 'k', which is not declared"),
    (lure, {"exact": [ca.SX.sym("x_0"), 0]}, "exact depends on 'x_0', but may depend only on t"),
    (
        sweeping,
        {"constraints": {"wall": q[0] + s}},
        "constraint 'wall' uses the symbol 's', which is not declared: add it to parameters={...}",
    ),
    (sweeping, {"q0": q}, "q0 depends on 'q_0', but may depend only on numbers; move that term elsewhere"),
    (sweeping, {"q": ca.SX.sym("z", 2)}, "constraint 'disc' uses the symbol 'q_0', which is not declared"),
    (sweeping, {"q": [q[0], q[0]]}, "q: the symbol 'q_0' is declared twice; give each symbol its own name"),
    (sweeping, {"t": q[0]}, "the declared symbols: the symbol 'q_0' is declared twice"),
    (sweeping, {"t": ca.SX.sym("t", 2)}, "t: 2 symbols given; expected one scalar time symbol"),
    (sweeping, {"t": 2 * t}, "t: (2.*t) (a SX) is not a symbol; expected symbols only, such as ca.SX.sym('t', 2)"),
    (sweeping, {"q": None}, "q: no state symbols are given; give for example q=ca.SX.sym('q', 2)"),
    (oscillator, {"x": []}, "x: no state symbols are given"),
    (oscillator, {"potential": ca.sumsqr(x) + s}, "potential depends on 's', but may depend only on x_0, x_1"),
    (oscillator, {"friction": 0.1 * k}, "friction 'friction' theta uses the symbol 'k', which is not declared"),
    (
        oscillator,
        {"friction": {"floor": ([1, 0], s * x[0])}},
        "friction 'floor' theta depends on 'x_0', but may depend only on s",
    ),
    (oscillator, {"friction": {"floor": ([x[0], 0], s)}}, "friction 'floor' H depends on 'x_0', but may depend only on numbers"),
    (oscillator, {"s": None}, "friction: theta is a function of one scalar symbol; declare it with s="),
    (oscillator, {"s": ca.SX.sym("s", 2)}, "friction: theta is a function of one scalar symbol; declare it with s="),
    (
        oscillator,
        {"t": t, "constraints": {"wall": x[0] + t}},
        "constraint 'wall' depends on 't', but may depend only on x_0, x_1",
    ),
    (first_order, {"f": [lam, 0]}, "f depends on 'l', but may depend only on t, x_0, x_1"),
    (first_order, {"M": [[x[0], 0], [0, 1]]}, "M depends on 'x_0', but may depend only on numbers"),
    (inclusion, {"t": t, "operator": None, "phi": t * x[0] ** 2}, "phi depends on 't', but may depend only on x_0, x_1"),
    (inclusion, {"t": t, "x0": [t, 0]}, "x0 depends on 't', but may depend only on numbers"),
    (inclusion, {"lower": x}, "lower depends on 'x_0', but may depend only on t"),
    (inclusion, {"scheme": "explicit"}, "scheme = 'explicit'; MonotoneInclusion has 'catching-up', 'implicit'"),
    (lure, {"scheme": "implicit"}, "scheme = 'implicit'; LureSystem has 'theta-gamma'"),
    (inclusion, {"scheme": "implicit", "tolerances": 1e-3}, "tolerances belong to the projections of catching-up, which scheme"),
    (inclusion, {"operator": relay(2, -k, 1)}, "operator: lower uses the symbol 'k', which is not declared"),
]

NUMBERS = [
    (lure, {"A": [[nan, 1], [0, 1]]}, "A[0, 0] holds a NaN; give a number"),
    (lure, {"A": [[0, inf], [0, 1]]}, "A[0, 1] = inf; expected a finite number"),
    (lure, {"B": [nan, 1]}, "B[0] holds a NaN"),
    (lure, {"B": [0, -inf]}, "B[1] = -inf; expected a finite number"),
    (lure, {"C": [nan, 1]}, "C[0] holds a NaN"),
    (lure, {"D": nan}, "D holds a NaN"),
    (lure, {"f": [inf, 0]}, "f[0] = inf; expected a finite number"),
    (lure, {"x0": [nan, 0]}, "x0[0] holds a NaN"),
    (lure, {"x0": [0, inf]}, "x0[1] = inf; expected a finite number"),
    (sweeping, {"q0": [0, nan]}, "q0[1] holds a NaN"),
    (sweeping, {"constraints": {"wall": q[0] * nan}}, "constraint 'wall' holds a NaN"),
    (oscillator, {"friction": {"floor": ([1, inf], s)}}, "friction 'floor' H[0, 1] = inf; expected a finite number"),
    (oscillator, {"v0": [0, inf]}, "v0[1] = inf; expected a finite number"),
    (oscillator, {"x1": [inf, 0]}, "x1[0] = inf; expected a finite number"),
    (oscillator, {"potential": inf}, "potential = inf; expected a finite number"),
    (first_order, {"M": [[inf, 0], [0, 1]]}, "M[0, 0] = inf; expected a finite number"),
    (first_order, {"lam0": inf}, "lam0 = inf; expected a finite number"),
    (inclusion, {"lower": [-1, nan]}, "lower[1] holds a NaN"),
    (inclusion, {"lower": 2, "upper": 1}, "lower[0] = 2, upper[0] = 1: C needs an interior, lower < upper"),
    (inclusion, {"lower": [0, 1], "upper": [2, 1]}, "lower[1] = 1, upper[1] = 1: C needs an interior"),
    (inclusion, {"upper": -inf}, "lower[0] = -1, upper[0] = -inf: C needs an interior"),
    (inclusion, {"tolerances": -1}, "tolerances[0] = -1; expected finite numbers >= 0"),
    (inclusion, {"tolerances": [0, nan]}, "tolerances[1] = nan; expected finite numbers >= 0"),
    (
        inclusion,
        {"tolerances": "small"},
        "tolerances: expected a number, a sequence of numbers or a function of the step, not 'small' (a str)",
    ),
    (
        inclusion,
        {"tolerances": []},
        "tolerances: expected a number, a sequence of numbers or a function of the step, not [] (a list)",
    ),
    (
        inclusion,
        {"tolerances": [1] * 3, "steps": [0.1, 0.1], "step": None, "t_end": None},
        "tolerances: 3 values for 2 steps; give one for each",
    ),
]

WORDS = [
    (lure, {"law": None}, "law and phi: give exactly one of them (phi with its symbols y=)"),
    (lure, {"phi": ca.fabs(y), "y": y}, "law and phi: give exactly one of them"),
    (lure, {"law": None, "phi": ca.fabs(y)}, "phi: declare its argument with y="),
    (lure, {"law": "relay"}, "law: expected a law such as complementarity(2) or relay(1, -1, 1), not 'relay' (a str)"),
    (lure, {"law": relay}, "law: expected a law such as complementarity(2) or relay(1, -1, 1), not <function relay"),
    (lure, {"theta": 1.1}, "theta = 1.1; expected a number in [0, 1]"),
    (lure, {"theta": True}, "theta = True; expected a number in [0, 1]"),
    (lure, {"gamma": -0.5}, "gamma = -0.5; expected a number in [0, 1]"),
    (first_order, {"gamma": nan}, "gamma = nan; expected a number in [0, 1]"),
    (first_order, {"theta": "implicit"}, "theta = 'implicit'; expected a number in [0, 1]"),
    (first_order, {"law": None}, "law missing: lam, h, g and law are given together, or none of them"),
    (first_order, {"h": None, "g": None}, "h, g missing: lam, h, g and law are given together, or none of them"),
    (lure_phi, {"phi": -ca.fabs(y)}, "phi is not convex: the term fabs(y) enters with the weight -1; make every weight >= 0"),
    (lure_phi, {"phi": ca.sign(y)}, "phi: sign in sign(y) has no subdifferential; write phi with fabs, fmax, norm_2"),
    (lure_phi, {"phi": ca.floor(y)}, "phi: floor in floor(y) has no subdifferential"),
    (oscillator, {"potential": -ca.fabs(x[0])}, "potential is not convex: the term fabs(x_0) enters with the weight -1"),
    (oscillator, {"v0": [1, 0], "x1": [1, 0]}, "v0 and x1 are both given; keep v0 (a velocity) or x1 (the second position)"),
    (oscillator, {"friction": 0.1}, "friction 'friction': theta = 0.1 does not depend on s = s; for Coulomb friction write mu*s"),
    (
        oscillator,
        {"friction": {"floor": 0.1 * s}},
        "friction 'floor': expected a pair (H, theta), H with 2 columns, not SX((0.1*s)) (a SX)",
    ),
    (
        oscillator,
        {"friction": {"floor": ([1, 0],)}},
        "friction 'floor': expected a pair (H, theta), H with 2 columns, not ([1, 0],) (a tuple)",
    ),
    (sweeping, {"constraints": [q[0]]}, "constraints: expected a dictionary {name: expression >= 0}, not a list"),
    (oscillator, {"constraints": x[0]}, "constraints: expected a dictionary {name: expression >= 0}, not a SX"),
    (inclusion, {"constraints": "x_0"}, "constraints: expected a dictionary {name: expression >= 0}, not a str"),
    (
        sweeping,
        {"constraints": {"wall": q[0] >= -5}},
        "constraint 'wall': (-5<=q_0) is a comparison; give the expression that stays >= 0, such as q[0] - 1",
    ),
    (
        inclusion,
        {"operator": equality(2)},
        "operator: component 0 is an equality; C would have no interior. Eliminate that state",
    ),
    (inclusion, {"operator": ball(2)}, "operator: a law of size 2 made of boxes is expected"),
    (inclusion, {"phi": ca.fabs(x[0])}, "operator and phi are both given; keep one"),
    (
        inclusion,
        {"operator": None, "phi": ca.fmax(ca.fabs(x[0]), ca.fmax(x[1], x[0]))},
        "phi: there is no explicit selection for nested nonsmooth terms; write a sum of fabs, fmax, norm_2",
    ),
    (
        inclusion,
        {"operator": None, "phi": ca.if_else(x[0] == 0, 0, inf)},
        "phi: an equality leaves C without interior; eliminate a state instead",
    ),
    (inclusion, {"operator": ca.sign(ca.sign(x))}, "operator: sign(sign(x_0)) has a sign inside a sign"),
    (sweeping, {"mean_forcing": "no"}, "mean_forcing = 'no'; expected True or False"),
    (sweeping, {"scene": 5}, "scene: 5 (a int); expected a dictionary {'radii': [...], 'walls': [...]}"),
    (
        sweeping,
        {"scene": {"radius": [1]}},
        "scene: {'radius': [1]} (a dict); expected a dictionary {'radii': [...], 'walls': [...]}",
    ),
    (sweeping, {"scene": {"radii": ["a"]}}, "scene: radii and walls must be numbers, walls of shape (W, 2, 2)"),
    (sweeping, {"scene": {"radii": [-1]}}, "scene: radii must be finite numbers > 0, walls finite numbers"),
    (sweeping, {"scene": {"radii": [1, 2]}}, "scene: 2 radii for 2 states; expected one radius for each pair (x_i, y_i)"),
    (
        sweeping,
        {"scene": {"radii": [1], "walls": [[0, 0], [1, 1]]}},
        "scene: walls has shape (2, 2); expected (W, 2, 2), two end points for each wall",
    ),
    (
        sweeping,
        {"f": [sympy.Function("drift")(sympy.Symbol("q_0")), 0]},
        "f: 'drift' in drift(q_0) has no CasADi counterpart; write it with elementary functions",
    ),
    (sweeping, {"f": mx_that_does_not_expand()}, "f cannot be written with scalar operations"),
]

TYPES = [
    (lure, {"A": "A"}, "A: A (a str) is not an expression; expected a number, a list, an array, CasADi SX or MX, or SymPy"),
    (lure, {"A": None}, "A: None (a NoneType) is not an expression"),
    (lure, {"A": [["a", "b"], ["c", "d"]]}, "A: a (a str) is not an expression"),
    (lure, {"A": {"a": 1}}, "A: {'a': 1} (a dict) is not an expression"),
    (lure, {"A": [[1j, 0], [0, 1]]}, "A: 1j (a complex) is not an expression"),
    (lure, {"B": np.array([0, 1j])}, "(a complex) is not an expression"),
    (lure, {"B": ["0", "1"]}, "B: 0 (a str) is not an expression"),
    (lure, {"A": lambda x: x}, "(a function) is not an expression; call it with your symbols"),
    (lure, {"x0": None}, "x0: None (a NoneType) is not an expression"),
    (lure, {"x0": {"position": 1}}, "x0: {'position': 1} (a dict) is not an expression"),
    (sweeping, {"q": 5}, "q: 5 (a int) is not a symbol; expected symbols only, such as ca.SX.sym('q', 2)"),
    (sweeping, {"f": ["q_1", "0"]}, "f: q_1 (a str) is not an expression"),
    (sweeping, {"constraints": {"disc": None}}, "constraint 'disc': None (a NoneType) is not an expression"),
    (oscillator, {"potential": None}, "potential: None (a NoneType) is not an expression"),
    (first_order, {"lam": 5}, "lam: 5 (a int) is not a symbol"),
]

GRIDS = [
    ({"t_end": None}, "t_end is missing; give the end of the run, a number > 0"),
    ({"t_end": 0}, "t_end = 0; expected a number > 0"),
    ({"t_end": "1"}, "t_end = '1' is not a number"),
    ({"t_end": True}, "t_end = True is not a number"),
    ({"t_end": k}, "t_end = SX(k) is not a number"),
    ({"t_end": inf}, "t_end = inf; expected a finite number"),
    ({"step": -1}, "step = -1; expected a number > 0"),
    ({"step": 0}, "step = 0; expected a number > 0"),
    ({"step": nan}, "step = nan; expected a finite number"),
    ({"step": inf}, "step = inf; expected a finite number"),
    ({"step": [0.1]}, "step = [0.1] is not a number"),
    ({"steps": [0.1]}, "step and steps are both given; keep one"),
    ({"step": None, "t_end": None, "steps": []}, "steps is empty; expected finite numbers > 0"),
    ({"step": None, "t_end": None, "steps": [0.1, 0]}, "steps[1] = 0; expected finite numbers > 0"),
    ({"step": None, "t_end": None, "steps": [nan]}, "steps[0] = nan; expected finite numbers > 0"),
    ({"step": None, "t_end": None, "steps": "ab"}, "steps: expected a list or 1-D array of numbers > 0, not 'ab' (a str)"),
    ({"step": None, "t_end": None, "steps": np.ones((2, 2))}, "steps: expected a list or 1-D array of numbers > 0, not array("),
    ({"step": None, "t_end": 5, "steps": [0.1, 0.1]}, "t_end = 5 but the steps sum to 0.2; leave t_end out"),
    ({"parameters": [1]}, "parameters: expected a dictionary {symbol or name: value}, not a list"),
    ({"parameters": {"k": nan}}, "parameter 'k' = nan; expected a finite number"),
    ({"parameters": {"k": "2"}}, "parameter 'k' = '2' is not a number"),
    ({"parameters": {k: [1, 2]}}, "parameter 'k': 2 values; expected one number"),
    ({"parameters": {("a", "b"): 1}}, "parameter 'a, b': 1 value; expected 2, one for each of a, b"),
    ({"parameters": {"k": 1, k: 2}}, "parameters: 'k' is declared twice; keep one"),
    ({"parameters": {2 * k: 1}}, "parameters: (2.*k) (a SX) is not a symbol"),
    ({"parameters": {"x_0": 1}}, "the declared symbols: the symbol 'x_0' is declared twice"),
    ({"names": ["a"]}, "names: ['a']; expected a list of 2 names, one for each of x_0, x_1"),
    ({"names": "ab"}, "names: 'ab'; expected a list of 2 names"),
    ({"names": ["a", 2]}, "names: ['a', 2]; expected a list of 2 names"),
    ({"names": ["a", "a"]}, "names: ['a', 'a'] repeats a name; give each state its own"),
    (
        {"names": ["energy", "b"]},
        "names: 'energy' clashes with run.energy, an attribute of runs; take another name, such as 'energy1'",
    ),
    ({"names": ["x", "v"]}, "names: 'x' clashes with run.x, which holds all states; take another name, such as 'x1'"),
    ({"x0": [1, 0, 2]}, "x0: 3 numbers; expected 2, one for each state, as A has the shape (2, 2)"),
    ({"x0": [1, 0, 2], "names": ["a", "b"]}, "x0: 3 numbers; expected 2, one for each state, as A has the shape (2, 2)"),
    ({"x0": 1}, "x0: 1 number; expected 2, one for each state, as A has the shape (2, 2)"),
    (
        {"names": ["position", "speed"], "units": {"postion": "m"}},
        "units: 'postion' is not a state, multiplier or time; the model has t, position, speed, l_0. Did you mean 'position'?",
    ),
    ({"units": {"T": "s"}}, "units: 'T' is not a state, multiplier or time; the model has t, x, x_0, x_1, l_0"),
    ({"units": "m"}, "units: 'm'; expected a dictionary {name: unit} of strings"),
    ({"units": {"t": 1}}, "units: {'t': 1}; expected a dictionary {name: unit} of strings"),
    ({"exact": [1, 2, 3]}, "exact: shape (3, 1); expected a column of 2 entries"),
]


def declared_with(rows):
    """Parametrise by rows of (builder, what is given, what the message says)."""
    ids = [f"{builder.__name__}-{'-'.join(given)}-{i}" for i, (builder, given, _) in enumerate(rows)]
    return pytest.mark.parametrize(("builder", "given", "message"), rows, ids=ids)


@declared_with(SHAPES + SYMBOLS + NUMBERS + WORDS + TYPES + [(lure, *row) for row in GRIDS])
def test_a_wrong_model_is_refused_when_it_is_declared(builder, given, message):
    with pytest.raises(ModelError, match=re.escape(message)):
        builder(**given)


@pytest.mark.parametrize("name", sorted(RESERVED_RUN_NAMES))
def test_no_state_takes_the_name_of_an_attribute_of_the_run(name):
    with pytest.raises(ModelError, match=rf"names: '{name}' clashes with run\.{name}, an attribute of runs; take another name"):
        lure(names=[name, "other"])
    with pytest.raises(ModelError, match=rf"x: the state '{name}' clashes with run\.{name}, an attribute of runs; rename it, or"):
        lure(x=ca.SX.sym(name, 2), A=np.eye(2))


def test_reserved_names_are_all_attributes_and_arrays_of_every_class():
    runs = [simulate(build()) for build in (lure, sweeping, oscillator, first_order, inclusion)]
    runs.append(simulate(first_order(h=x[1] + lam**3)))
    taken = {name for name in dir(nsmodel.Trajectory) if not name.startswith("_")}
    taken |= {name for run in runs for name in run.arrays}
    assert taken - {"x", "v"} <= RESERVED_RUN_NAMES
    for builder in (oscillator, inclusion):
        with pytest.raises(ModelError, match=r"names: 'v' clashes with run\.v, the velocity; take another name, such as 'v1'"):
            builder(names=["v", "w"])
    v = ca.SX.sym("v", 2)
    with pytest.raises(ModelError, match=r"x: the state 'v' clashes with run\.v, the velocity; rename it, or give names=\[...\]"):
        inclusion(x=v, field=-v, operator=None)
    pair = [ca.SX.sym("x"), ca.SX.sym("u")]
    with pytest.raises(ModelError, match=r"x: the state 'x' clashes with run\.x, which holds all states; rename it, or give"):
        lure(x=pair)
    np.testing.assert_array_equal(simulate(lure(x=pair, names=["x1", "u"])).x1[0], 1)  # As it says.
    np.testing.assert_array_equal(simulate(lure(names=["u", "v"])).v[0], 0)  # A Lur'e system has no other v.


# laws


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: relay(-1), "relay: the number of components must be a whole number >= 0, not -1"),
        (lambda: complementarity(1.5), "complementarity: the number of components must be a whole number >= 0, not 1.5"),
        (lambda: equality("a"), "equality: the number of components must be a whole number >= 0, not 'a'"),
        (lambda: second_order_cone(True), "second_order_cone: the number of components must be a whole number >= 0, not True"),
        (lambda: ball([2]), "ball: the number of components must be a whole number >= 0, not [2]"),
        (lambda: relay(1, 2), "relay: lower[0] = 2 is above upper[0] = 1; for -F <= l <= F write relay(1, -2, 2)"),
        (lambda: relay(1, 1, -1), "relay: lower[0] = 1 is above upper[0] = -1; exchange them"),
        (lambda: box([0, 1], [1, 0]), "box: lower[1] = 1 is above upper[1] = 0; exchange them"),
        (lambda: relay(2, [k, 1], [2, 0]), "relay: lower[1] = 1 is above upper[1] = 0; exchange them"),
        (lambda: box(inf, inf), "box: component 0 has the empty interval [inf, inf]; give lower < inf, upper > -inf"),
        (lambda: relay(1, nan, 1), "relay: lower[0] is NaN; give a number or +-inf"),
        (lambda: relay(2, [1, 2, 3], 5), "relay: lower has 3 values; expected 1 or 2"),
        (lambda: ball(2, [1, 2]), "ball: radius has 2 values; expected 1"),
        (lambda: relay(1, "a", 1), "relay: lower = 'a'; expected a number, a list of numbers or a CasADi SX"),
        (lambda: relay(1, None), "relay: lower = None; expected a number"),
        (lambda: relay(1, 1j), "relay: lower = 1j; expected a number"),
        (lambda: relay(1, {}), "relay: lower = {}; expected a number"),
        (lambda: box([[0, 1], [1]], 1), "box: lower = [[0, 1], [1]]; expected a number"),
        (lambda: relay(1, ca.MX.sym("k")), "relay: lower = MX(k); expected a number, a list of numbers or a CasADi SX"),
        (lambda: ball(2, -1), "ball: radius = -1 must be finite and not negative"),
        (lambda: ball(1, -1), "ball: radius = -1 must be finite and not negative"),
        (lambda: ball(2, inf), "ball: radius = inf must be finite and not negative"),
        (lambda: ball(1, "a"), "ball: radius = 'a'; expected a number"),
        (
            lambda: polyhedron([[1, 0]], [1, 2]),
            "polyhedron: H has shape (1, 2) and K (2,); expected (r, m) and (r,) with the same r",
        ),
        (lambda: polyhedron("a", 1), "polyhedron: H = 'a', K = 1; expected numbers"),
        (lambda: polyhedron(k, 1), "polyhedron: H = SX(k), K = 1; expected numbers"),
        (
            lambda: polyhedron([[1, inf]], [1]),
            "polyhedron: H and K must be finite; leave the row out instead of making it infinite",
        ),
        (lambda: product(relay(1), 5), "product: argument 1 is a int; expected a law such as relay(2)"),
    ],
)
def test_a_wrong_law_is_refused(build, message):
    with pytest.raises(ModelError, match=f"^{re.escape(message)}"):
        build()


# what is right, in forms that are easily taken for wrong


@pytest.mark.parametrize(
    ("builder", "given"),
    [
        (lure, {"A": scipy.sparse.csr_matrix([[0, 1], [-1, 0]])}),
        (lure, {"A": ca.DM([[0, 1], [-1, 0]]), "x0": ca.DM([1, 0])}),
        (lure, {"x": x, "A": [x[1], -x[0]]}),
        (lure, {"B": [[0, 1]], "C": [[0], [1]]}),
        (lure, {"B": np.array([False, True])}),
        (lure, {"x0": np.array([[1.0], [0.0]])}),
        (lure, {"theta": np.float32(0.5), "gamma": 1}),
        (lure, {"parameters": {"k": 2}, "law": relay(1, -k, k)}),
        (lure, {"parameters": {("a", "b"): [1, 2]}, "x0": [ca.SX.sym("a"), ca.SX.sym("b")]}),
        (lure, {"title": None, "units": None}),
        (lure_phi, {"phi": 0}),
        (sweeping, {"constraints": None}),
        (sweeping, {"f": [sympy.Symbol("q_1"), 0]}),
        (sweeping, {"f": 2 * ca.MX.sym("q", 2)}),
        (oscillator, {"friction": None, "s": None}),
        (inclusion, {"lower": None, "upper": [1, inf]}),
        (inclusion, {"tolerances": lambda h: h**2}),
    ],
)
def test_other_forms_of_a_right_model_run(builder, given):
    assert simulate(builder(**given)).status == "done"


def test_parameters_of_a_law_are_the_declared_ones():
    """A law with a symbol that is not declared once ran with NaN for it."""
    by_name = simulate(lure(parameters={"k": 0.5}, law=relay(1, -k, k)))
    np.testing.assert_array_equal(by_name.x, simulate(lure(law=relay(1, -0.5, 0.5))).x)


def test_the_exact_solution_takes_the_values_of_the_parameters():
    model = lure(t=t, parameters={k: None}, exact=[ca.exp(-k * t), 0]).bind({"k": 2})
    np.testing.assert_allclose(model.exact([0, 1]), [[1, 0], [np.exp(-2), 0]])


# runs that are refused


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (
            lambda: sweeping(q0=[0.5, 0]),
            "constraint 'disc' = -0.5 < 0 at the start q0 = (0.5, 0): the start is outside the set; move it to where",
        ),
        (lambda: sweeping(constraints={"wall": t - 1}), "constraint 'wall' = -1 < 0 at the start q0 = (-2, 0.1)"),
        (lambda: sweeping(constraints={"walls": ca.vertcat(q[0] + 5, q[1] - 1)}), "constraint 'walls[1]' = -0.9 < 0"),
        (
            lambda: sweeping(q0=[0, 0]),
            "constraint 'disc': its gradient at the start q0 = (0, 0) is not a finite number (a norm at 0",
        ),
        (
            lambda: sweeping(constraints={"root": ca.sqrt(q[0])}),
            "constraint 'root': its value at the start q0 = (-2, 0.1) is not a finite number",
        ),
        (lambda: inclusion(x0=[3, 0]), "constraint 'upper x_0' = -1 < 0 at the start x0 = (3, 0)"),
        (
            lambda: inclusion(constraints={"disc": 1 - ca.sumsqr(x)}, x0=[1, 1]),
            "constraint 'disc' = -1 < 0 at the start x0 = (1, 1)",
        ),
        (lambda: oscillator(constraints={"wall": x[0] - 5}), "constraint 'wall' = -4 < 0 at the start x0 = (1, 0)"),
        (
            lambda: oscillator(constraints={"wall": x[0] - 1}, x1=[0.5, 0]),
            "constraint 'wall' = -0.5 < 0 at the start x1 = (0.5, 0)",
        ),
        (
            lambda: oscillator(friction={"floor": ([1, 0], -0.3 * s)}),
            "friction 'floor': theta = (-0.3*s) has theta'(0) = -0.3; the friction force at rest must be a finite number >= 0",
        ),
        (
            lambda: oscillator(friction={"floor": (np.eye(2), k * s)}, parameters={k: -2}),
            "has theta'(0) = -2 with k = -2; the friction force at rest must be",
        ),
        (lambda: oscillator(friction=ca.sqrt(s)), "friction 'friction': theta = sqrt(s) has theta'(0) = inf"),
        (
            lambda: oscillator(potential=k * ca.fabs(x[0]), parameters={k: -1}),
            "potential: the term 'abs' of x_0 has the weight -1 with k = -1; a convex potential needs finite weights >= 0",
        ),
        (
            lambda: oscillator(potential=k * ca.norm_2(x), parameters={k: -1}),
            "potential: the term 'norm' of [x_0, x_1] has the weight -1",
        ),
        (lambda: lure_phi(k * ca.fmax(y, 0), parameters={k: -1}), "phi: the term 'max' of y has the weight -1 with k = -1"),
        (
            lambda: inclusion(operator=None, phi=k * ca.fabs(x[0]), parameters={k: -1}),
            "phi: the term 'abs' of x_0 has the weight -1",
        ),
        (lambda: lure(law=relay(1, -k, k), parameters={k: -1}), "law: relay has lower[0] = 1 above upper[0] = -1 with k = -1"),
        (lambda: first_order(law=box(k, 1), parameters={k: 5}), "law: box has lower[0] = 5 above upper[0] = 1 with k = 5"),
        (
            lambda: lure_2(law=ball(2, k), parameters={k: -1}),
            "law: the ball has the radius -1 with k = -1; expected a finite number >= 0",
        ),
        (
            lambda: inclusion(lower=k, parameters={k: 5}),
            "lower[0] = 5, upper[0] = 2 with k = 5: C needs an interior, lower < upper",
        ),
        (lambda: lure(B=[0, 1 / k], parameters={k: 0}), "with k = 0, B[1] = inf; expected a finite number"),
        (lambda: lure(x0=[ca.sqrt(k), 0], parameters={k: -1}), "with k = -1, x0[0] = nan; expected a finite number"),
        (lambda: lure(parameters={k: None}), "parameter 'k' has no value; give it with --set k=VALUE or parameters={...}"),
        (lambda: lure(step=None), "no time step: give the model step=, or the run step=H (--step H)"),
        (lambda: lure(step=1e-13), "t_end / step = 1e+13 steps; choose a larger step or a shorter run"),
        (
            lambda: first_order(law=complementarity(1), x0=[1, -1], gamma=0.5),
            "gamma < 1 needs a multiplier at the start, and the law has none there",
        ),
    ],
)
def test_a_run_that_cannot_start_is_refused(model, message):
    declared = model()
    with pytest.raises(UsageError, match=re.escape(message)):
        simulate(declared)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"step": -1}, "step = -1; expected a finite number > 0"),
        ({"t_end": nan}, "t_end = nan; expected a finite number > 0"),
        ({"step": 0.1, "steps": [0.1]}, "step and steps are both given; keep one"),
        ({"steps": []}, "steps is empty"),
        ({"steps": [0.1, -1]}, "steps[1] = -1; expected finite numbers > 0"),
        ({"steps": [0.1], "t_end": 1}, "t_end is given with steps, which already say where the run ends; leave it out"),
        ({"tolerance": 1e-15}, "tolerance = 1e-15; expected a number between 1e-14 and 1: doubles hold no more than 16 digits"),
        ({"tolerance": 0}, "tolerance = 0; expected a number between 1e-14 and 1"),
        ({"tolerance": 1}, "tolerance = 1; expected a number between 1e-14 and 1"),
        ({"save_every": 0}, "save_every = 0; expected a whole number >= 1"),
        ({"save_every": 1.5}, "save_every = 1.5; expected a whole number >= 1"),
        ({"save_every": True}, "save_every = True; expected a whole number >= 1"),
        ({"resume": True}, "resume needs out=, the folder of the run to continue"),
        ({"parameters": {"kk": 1}}, "parameter 'kk' is not declared; the model has k. Did you mean 'k'?"),
        (
            {"parameters": {"other": 1}},
            "parameter 'other' is not declared; the model has k; an argument of a file's model() goes to load(FILE, other=...)",
        ),
        ({"parameters": [1]}, "parameters: expected a dictionary {name: value}, not a list"),
        ({"solver": "simplex"}, "solver 'simplex' is unknown; choose one of auto, qpoases"),
    ],
)
def test_a_wrong_argument_of_a_run_is_refused(given, message):
    with pytest.raises(UsageError, match=re.escape(message)):
        simulate(lure(parameters={k: 1}), **given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"step": "a"}, "step = 'a'; expected a finite number > 0"),
        ({"step": True}, "step = True; expected a finite number > 0"),
        ({"step": [0.1]}, "step = [0.1]; expected a finite number > 0"),
        ({"t_end": k}, "t_end = SX(k); expected a finite number > 0"),
        ({"steps": "ab"}, "steps: expected a list or 1-D array of numbers > 0, not 'ab' (a str)"),
        ({"steps": 0.1}, "steps: expected a list or 1-D array of numbers > 0, not 0.1 (a float)"),
        ({"tolerance": "small"}, "tolerance = 'small'; expected a number between 1e-14 and 1"),
        ({"tolerance": None}, "tolerance = None; expected a number between 1e-14 and 1"),
        ({"save_every": "a"}, "save_every = 'a'; expected a whole number >= 1"),
        ({"save_every": nan}, "save_every = nan; expected a whole number >= 1"),
    ],
)
def test_an_argument_of_another_type_is_refused(given, message):
    with pytest.raises(UsageError, match=re.escape(message)):
        simulate(lure(), **given)


@pytest.mark.parametrize("model", [None, "model.py", LureSystem])
def test_what_is_no_model_is_not_run(model):
    for call in (simulate, nsmodel.explain):
        with pytest.raises(
            UsageError, match=r"expected a model such as LureSystem\(\.\.\.\), not .*; a file is read with nsmodel\.load"
        ):
            call(model)


def test_an_exact_solution_of_another_shape_is_refused():
    with pytest.raises(UsageError, match=r"exact: it returned shape \(3,\) for \d+ times; expected \(\d+, 2\)"):
        simulate(lure(exact=lambda t: np.zeros(3)))


def test_a_wrong_value_for_a_parameter_is_refused():
    with pytest.raises(ModelError, match=r"parameter 'k' = nan; expected a finite number"):
        simulate(lure(parameters={k: None}), parameters={"k": nan})


@pytest.mark.parametrize(
    ("model", "solver", "message"),
    [
        (
            lambda: lure(law=complementarity(0), B=np.zeros((2, 0)), C=np.zeros((0, 2))),
            "qpoases",
            "solver 'qpoases' does not apply: the model has no multipliers; leave --solver out",
        ),
        (
            lambda: lure_2(law=ball(2)),
            "qpoases",
            "solver 'qpoases' does not apply: the law has balls; use semismooth or ipopt",
        ),
        (
            lambda: lure(D=-5),
            "qrqp",
            "solver 'qrqp' does not apply: the step is not a convex QP (least eigenvalue of W + W' -1); use active-set",
        ),
    ],
)
def test_a_solver_that_does_not_apply_is_refused_with_the_reason(model, solver, message):
    with pytest.raises(UsageError, match=re.escape(message)):
        simulate(model(), solver=solver)


@pytest.mark.parametrize(
    ("tolerances", "message"),
    [
        (lambda h: -h, "tolerances(0.1) = -0.1; expected a finite number >= 0"),
        (lambda h: "small", "tolerances(0.1) = 'small'; expected a finite number >= 0"),
        (lambda: 1, "tolerances: called with the step 0.1, the function fails"),
    ],
)
def test_a_wrong_tolerance_function_is_refused(tolerances, message):
    with pytest.raises(ModelError, match=re.escape(message)):
        simulate(inclusion(tolerances=tolerances))


def test_a_set_without_interior_is_refused_where_the_scheme_needs_one():
    line = {"right": x[0], "left": -x[0]}
    with pytest.raises(ModelError, match=r"constraints: no point with all c\(x\) > 0 was found; C needs an interior"):
        simulate(inclusion(constraints=line, lower=None, upper=None, x0=[0, 0], tolerances=1e-3))


# hypotheses that fail load and run, with a warning


@pytest.mark.parametrize(
    ("model", "warning"),
    [
        (lambda: lure(D=-1), "D is not positive semidefinite (least eigenvalue of its symmetric part -1)"),
        (lambda: lure(D=-1), "the one-step problem is not monotone"),
        (lambda: oscillator(friction=s - 1e-3 * s**2), "theta of 'friction' decreases: theta'(1e+03) = -1 < 0"),
        (lambda: oscillator(friction={"floor": ([1, 0], ca.log(1 + s))}), "theta of 'floor' is not convex: theta''(0) = -1 < 0"),
        (
            lambda: oscillator(potential=ca.sumsqr(x) / 2 - 2 * x[1] ** 2),
            "the potential is not convex at x0 (least eigenvalue of its Hessian -3)",
        ),
        (
            lambda: oscillator(damping=-0.1 * np.eye(2)),
            "damping is not positive semidefinite (least eigenvalue of its symmetric part -0.1)",
        ),
        (
            lambda: sweeping(constraints={"room": 9 - ca.sumsqr(q)}),
            "constraint 'room' is not convex at q0 (least eigenvalue of its Hessian -2): feasibility may be lost",
        ),
    ],
)
def test_a_hypothesis_that_fails_is_a_warning(model, warning):
    run = simulate(model())
    assert run.status == "done"
    assert any(warning in line for line in run.metadata["warnings"]), run.metadata["warnings"]
    assert "warnings" in run.summary_text()


@pytest.mark.parametrize("build", [lure, sweeping, oscillator, first_order, inclusion])
def test_a_model_that_keeps_to_its_hypotheses_has_no_warning(build):
    assert simulate(build()).metadata["warnings"] == []


# steps that fail


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (
            lambda: sweeping(f=[0, 0], constraints={"left": 1 - t - q[0], "right": q[0] + 0.5 - t}, q0=[0, 0]),
            "step 7: no verified step from t = 0.7 to 0.8: the constraints leave no point: 'left' (weight "
            "0.5) and 'right' (weight 0.5) oppose each other",
        ),
        pytest.param(
            lambda: first_order(f=[ca.sqrt(x[1]), -1], g=[0, 0 * lam], x0=[1, 0.75]),
            "step 7: no verified step from t = 0.7 to 0.8: ",
        ),
        (
            lambda: inclusion(field=1 / x),
            "step 0: field - operator is not finite at t = 0, x = [1. 0.]: a division by 0 or a root of a negative number?",
        ),
        (
            lambda: inclusion(t=t, field=[0, 0], lower=[t - 0.35, -2], upper=[0, 2], x0=[-0.1, 0]),
            "step 3: C is empty at t = 0.4: lower[0] = 0.05 > upper[0] = 0",
        ),
        (lambda: first_order(M=np.zeros((2, 2)), f=[0, 0]), "step 0: the step's matrix is singular at h = 0.1"),
        (
            lambda: LureSystem(
                x=x[0], t=t, A=ca.if_else(x[0] > 1, 0, 2), B=[0], C=[0], law=relay(1), x0=[0.9], t_end=1, step=0.1
            ),
            "step 0: no verified step from t = 0 to 0.1: no solver reached the tolerance; a jump in the model (sign, floor, "
            "if_else) must be written as a law, such as relay or complementarity",
        ),
        (
            lambda: first_order(f=[ca.fmax(x[0], 0.3) ** 2 + 9, -x[1]]),
            "step 1: no verified step from t = 0.1 to 0.2: Newton's method did not converge. Best",
        ),
    ],
)
def test_a_step_that_fails_says_why(model, message):
    with pytest.raises(StepError, match=re.escape(message)) as caught:
        simulate(model())
    error = caught.value
    assert error.trajectory.status == "failed"
    assert error.trajectory.metadata["message"] == str(error)
    assert len(error.trajectory) == error.step
    assert error.time == pytest.approx(0.1 * (error.step + 1))


@pytest.mark.parametrize(
    ("start", "solves", "iterations", "message"),
    [
        ([0, 0], False, 60, "no verified selection of the operator at t = 0, x = [0. 0.]"),
        ([0.9, 0.1], False, 60, "approximate projection at t = 0: the projection on the linearised set was not found"),
        ([0.9, 0.1], True, 0, "approximate projection at t = 0: excess inf stays above eps_k = 0.001"),
    ],
)
def test_catching_up_says_what_it_could_not_verify(monkeypatch, start, solves, iterations, message):
    """No model is known that brings these about: the solver is made to fail."""
    solve = catching_up.mlcp.solve_mlcp
    monkeypatch.setattr(catching_up, "CUT_ITERATIONS", iterations)
    monkeypatch.setattr(
        catching_up.mlcp, "solve_mlcp", lambda *args: solve(*args) if solves else replace(solve(*args), residual=inf)
    )
    disc = {"disc": 1 - ca.sumsqr(x)}
    with pytest.raises(StepError, match=re.escape(message)):
        simulate(inclusion(field=[5, 0], constraints=disc, lower=None, upper=None, x0=start, tolerances=1e-3))


# results


def test_errors_of_a_trajectory(tmp_path, monkeypatch):
    run = simulate(lure())
    with pytest.raises(UsageError, match=r"no multiplier is called 'force'; this run has l_0"):
        run.multiplier("force")
    with pytest.raises(AttributeError, match=r"this run has no 'q'; it has x, x_0, x_1, t, multipliers"):
        _ = run.q
    with pytest.raises(StorageError, match=r"missing\.npz does not exist; check the path"):
        nsmodel.Trajectory.load(tmp_path / "missing.npz")
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"cannot write .*file/a\.npz: .*; take a folder that is writable"):
        run.save(tmp_path / "file" / "a.npz")
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(StorageError, match=r"cannot write into .*closed: no permission; take a folder that is writable"):
        simulate(lure(), out=tmp_path / "closed")
    monkeypatch.undo()
    with pytest.raises(StorageError, match=r"cannot write into .*file/out: .*; take a folder that is writable"):
        simulate(lure(), out=tmp_path / "file" / "out")


# -- explicit time where a scheme has none -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: oscillator(t=t, potential=ca.sumsqr(x) / 2 - ca.sin(t) * x[0]),
            "potential depends on 't', but may depend only on",
        ),
        (lambda: oscillator(t=t, friction={"rail": (ca.horzcat(t, 1), s)}), "friction 'rail' H depends on 't'"),
        (lambda: oscillator(t=t, constraints={"wall": x[0] - t}), "constraint 'wall' depends on 't'"),
    ],
)
def test_an_oscillator_says_where_time_may_stand(build, message):
    with pytest.raises(ModelError, match=re.escape(message)) as refused:
        build()
    assert "time and inputs stand in force= and friction=, and there alone: section 2.2 of the guide" in str(refused.value)


def test_a_lure_system_is_the_oscillator():
    """Position and velocity as a Lur'e system, with friction as a relay: without a force the same motion; with one, x'' = f."""
    force, mu = ca.sin(t), 0.3
    H, M, gradient = np.array([[1.0, 0.5]]), np.diag([0.2, 0.1]), ca.vertcat(4 * x[0], x[1])
    v = ca.SX.sym("v", 2)

    def recipe(f, mu):
        return LureSystem(
            t=t, x=[x, v], A=ca.vertcat(v, -(gradient + M @ v)), f=ca.vertcat(0, 0, f, 0), B=np.vstack([np.zeros((2, 1)), H.T]),
            C=np.hstack([np.zeros((1, 2)), H]), law=relay(1, -mu, mu), x0=[1, 1, 0, 1], t_end=2, step=1e-3,
        )  # fmt: skip

    own = oscillator(
        potential=(4 * x[0] ** 2 + x[1] ** 2) / 2,
        friction={"rail": (H, mu * s)},
        damping=M,
        x0=[1, 1],
        v0=[0, 1],
        t_end=2,
        step=1e-3,
    )
    np.testing.assert_allclose(simulate(recipe(0, mu)).x[-1, :2], simulate(own).x[-1], atol=5e-3)
    assert np.abs(simulate(recipe(force, mu)).x[-1, :2] - simulate(own).x[-1]).max() > 0.1


def test_an_inclusion_names_the_class_for_terms_of_time():
    with pytest.raises(ModelError, match=r"phi depends on 't', .*Write phi as operator.* or take a LureSystem, where"):
        inclusion(t=t, operator=None, phi=t * ca.sumsqr(x))


# -- units -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("builder", "names"),
    [
        (lure, ["t", "x", "x_1", "l_0", "y", "multipliers"]),
        (sweeping, ["q", "q_0", "disc", "reactions", "gap"]),
        (oscillator, ["x_0", "v", "friction", "friction[0]", "energy", "potential abs 0"]),
        (first_order, ["l", "residual_R"]),
        (inclusion, ["lower x_0", "v", "defect"]),
    ],
)
def test_units_name_what_a_run_has(builder, names):
    model = builder(units=dict.fromkeys(names, "m"))
    assert simulate(model).metadata["units"] == dict.fromkeys(names, "m")
    with pytest.raises(ModelError, match=r"units: 'reactons' is not a state, multiplier or time; the model has t, "):
        builder(units={"reactons": "N"})


def test_units_of_many_bodies_and_of_parameters():
    bodies = nsmodel.Bodies([[0.0, 0.0], [3.0, 0.0]], r=[1.0, 1.0])
    i, j = bodies.member("i"), bodies.member("j")
    pair = nsmodel.Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j)
    given = {"bodies": bodies, "constraints": {"pair": pair}, "t_end": 1, "step": 0.1}
    model = nsmodel.ManyBodies(units={"q": "m", "r": "m", "pair": "N", "pressure": "N"}, **given)
    assert dict(model.written_out().units) == {"q": "m"}
    with pytest.raises(ModelError, match=r"units: 'pairs' is not a state, multiplier or time; .* Did you mean 'pair'"):
        nsmodel.ManyBodies(units={"pairs": "N"}, **given)
    assert lure(parameters={"th": [1, 2]}, units={"th": "N", "th_0": "N"})


# -- model files -------------------------------------------------------------------------------------------------------


def test_a_model_file_imports_its_neighbours(tmp_path):
    body = "\nfrom nsmodel import LureSystem, relay\ndef model(n=1):\n    import late.inside\n    return LureSystem("
    body += "A=[[-late.inside.RATE]], B=1, C=1, law=relay(1), x0=START, t_end=1, step=0.1)\n"
    for folder, start in (("a", 1.0), ("b", 2.0)):
        (tmp_path / folder / "late").mkdir(parents=True)
        (tmp_path / folder / "common.py").write_text(f"START = {start}\n")
        (tmp_path / folder / "late" / "__init__.py").write_text("")
        (tmp_path / folder / "late" / "inside.py").write_text(f"RATE = {10 * start}\n")
        (tmp_path / folder / "m.py").write_text("from common import START" + body)
    path = list(sys.path)
    for folder, start in (("a", 1.0), ("b", 2.0), ("a", 1.0)):
        model = nsmodel.load(tmp_path / folder / "m.py")
        assert float(model.x0) == start
        assert f"{10 * start:g}" in str(model.A)
    assert sys.path == path
    assert not {"common", "late", "late.inside"} & set(sys.modules)
    (tmp_path / "a" / "common.py").write_text("START = 3.0\n")
    assert float(nsmodel.load(tmp_path / "a" / "m.py").x0) == 3


def test_no_bytecode_is_left_beside_a_model_file(tmp_path, monkeypatch):
    """It would be read instead of a file that was edited within the second and kept its length."""
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    (tmp_path / "common.py").write_text("START = 1.0\n")
    body = "from common import START\nfrom nsmodel import LureSystem, relay\n"
    (tmp_path / "m.py").write_text(body + "model = LureSystem(A=1, B=1, C=1, law=relay(1), x0=START, t_end=1, step=0.1)\n")
    assert float(nsmodel.load(tmp_path / "m.py").x0) == 1
    (tmp_path / "common.py").write_text("START = 3.0\n")
    assert float(nsmodel.load(tmp_path / "m.py").x0) == 3
    assert sorted(path.name for path in tmp_path.iterdir()) == ["common.py", "m.py"]
    assert sys.dont_write_bytecode is False


def test_a_model_file_without_its_neighbour_says_so(tmp_path):
    (tmp_path / "m.py").write_text("import nobody_is_called_so\n")
    with pytest.raises(ModelError, match=r"m.py:1: ModuleNotFoundError: No module named 'nobody_is_called_so'"):
        nsmodel.load(tmp_path / "m.py")


# -- what a message says was tried -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "tried"),
    [
        (FirstOrderSystem(x=x, f=[ca.exp(1e3 * x[0]), 0], x0=[1, 0], t_end=1, step=0.1), "Newton's method"),
        (FirstOrderSystem(x=x, f=[1e200 * x[0], 1e200 * x[1]], x0=[1e200, 0], t_end=1, step=0.1, theta=0.5), "the linear system"),
    ],
)
def test_a_step_without_solvers_says_how_it_was_tried(model, tried):
    with pytest.raises(StepError, match=rf"Tried: {tried}"):
        simulate(model, compiled=False)


def test_index_sets_that_were_not_tried_are_no_proof():
    """39 366 index sets are too many to be tried one by one; that none of them solves the step is not said."""
    t, law = ca.SX.sym("t"), product(relay(9), complementarity(1))
    zero = np.zeros((1, 10))
    model = LureSystem(t=t, A=[[0.0]], B=zero, C=-np.ones((10, 1)), D=-np.eye(10), f=[0], law=law, x0=[1], t_end=1, step=0.1)
    with pytest.raises(StepError) as failed:
        simulate(model)
    assert "index sets" not in str(failed.value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda: LureSystem(A=[[0]], B=[1], C=[1], laww=relay(1), x0=[1], t_end=1),
            r"LureSystem\(\) .* 'laww'. Did you mean 'law'",
        ),
        (lambda: relay(1, lowr=-1), "'lowr'. Did you mean 'lower'"),
        (lambda: nsmodel.pwm(1.0, 0.5, phas=0.2), "'phas'. Did you mean 'phase'"),
        (lambda: nsmodel.sampled("c", perod=1), "'perod'. Did you mean 'period'"),
        (lambda: nsmodel.sensitivity(None, by="a", outputts="x"), "'outputts'. Did you mean 'outputs'"),
        (lambda: nsmodel.simulate(None, rtoll=1e-6), "'rtoll'. Did you mean 'rtol'"),
        (lambda: nsmodel.check(None, parametres={}), "'parametres'. Did you mean 'parameters'"),
    ],
)
def test_a_misspelt_keyword_is_answered_by_what_is_near(call, message):
    with pytest.raises(TypeError, match=message):
        call()


def test_misspelt_attributes_and_words_of_newcomers(tmp_path):
    """Attributes of runs, sweeps and the package; a condition on a symbol; inputs in A; a step longer than the run."""
    p, u, x = ca.SX.sym("p"), ca.SX.sym("u"), ca.SX.sym("x")
    given = {"A": [[0]], "B": [1], "C": [1], "law": relay(1), "x0": [1], "t_end": 1.0}
    model = LureSystem(**given, step=0.1, parameters={p: 1.0})
    with pytest.raises(AttributeError, match=r"this run has no 'multiplers'; .* Did you mean 'multipliers'"):
        _ = (run := nsmodel.simulate(model)).multiplers
    with pytest.raises(AttributeError, match=r"this sweep has no 'sttaus'; .* Did you mean 'status'"):
        _ = (found := nsmodel.sweep(model, grid={"p": [1.0]}, keep="x")).sttaus
    for result in (run, found):
        with pytest.raises(AttributeError, match="Did you mean 'to_pandas'"):
            result.to_dataframe()  # As other libraries call it.
    with pytest.raises(AttributeError, match="Did you mean 'simulate'"):
        _ = nsmodel.simulte
    with pytest.raises(ModelError, match=r"A depends on 'u'.*FirstOrderSystem takes inputs anywhere"):
        LureSystem(**given | {"A": [[u]]}, inputs={u: 1.0})
    with pytest.raises(ModelError, match=r"'u', which is not declared: .* to inputs=\{...\} if it is a signal"):
        nsmodel.FirstOrderSystem(x=x, f=[u - x], x0=[1], t_end=1.0)
    with pytest.raises(UsageError, match="step = 5 is longer than the run, which ends at t_end = 1"):
        nsmodel.simulate(model, step=5.0)
    short = {
        "t_end": 0.05,
        "rtol": 1e-3,
    }  # Steps under error control begin with one; pieces, and libraries of steps, have no end.
    assert nsmodel.simulate(model, method="time-stepping", **short).t[-1] == 0.05
    assert nsmodel.sweep(model, grid={"p": [1.0]}, keep="x", times=[0.05], **short).status.tolist() == [0]
    nsmodel.codegen.write(model, tmp_path / "library", step=5.0)
    file = tmp_path / "condition.py"
    file.write_text('import casadi as ca\nx = ca.SX.sym("x")\nf = -1 if x > 0 else 1\nmodel = None\n')
    with pytest.raises(ModelError, match=r"condition.py:3: .*ca.if_else\(x > 0, a, b\)"):
        nsmodel.load(file)
