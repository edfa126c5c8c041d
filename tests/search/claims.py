"""Statements of small models with proofs by hand: false ones that a checker must refuse, and true ones beside them."""

from __future__ import annotations

import casadi as ca

from nsmodel.hypotheses.certificates.hints import straight_line_program

t, s, x, y, q = (ca.SX.sym(name) for name in "tsxyq")
z = ca.SX.sym("z", 2)
HALF_LINE = {"cover": None}


def program(expr, inputs=x):
    names = [str(symbol) for symbol in ca.vertsplit(inputs)]
    return straight_line_program(ca.SX(expr), inputs, names)


def sweeping(*rows, f=0, deltas=(), q0="0"):
    graphs = [{"name": f"g_{k}", "graph": program(row, ca.vertcat(t, q))} for k, row in enumerate(rows)]
    for graph, delta in zip(graphs, deltas, strict=False):
        graph["delta"] = delta
    return {"class": "SweepingProcess", "constraints": graphs, "f": program(f, ca.vertcat(t, q)), "q0": [q0]}


def oscillator(g=None, theta=(s,), H=((("1",),),), C=(), steps=("1",)):
    damping = []
    g = x**2 if g is None else g
    return {"class": "FrictionOscillator", "theta": [program(one, s) for one in theta], "H": [list(map(list, one)) for one in H],
            "x0": ["0"], "damping": damping, "g": program(g), "C": program(ca.vertcat(*C)), "steps": list(steps)}  # fmt: skip


def first_order(f, g=0, h=0, law=None, steps=("1/10",), M="1"):
    inputs = ca.vertcat(t, x, y)
    law = law or [{"kind": "box", "size": 1, "lower": ["-1"], "upper": ["1"]}]
    return {"class": "FirstOrderSystem", **{name: program(part, inputs) for name, part in (("f", f), ("g", g), ("h", h))},
            "M": [[M]], "theta": "1", "gamma": "1", "x0": ["0"], "steps": list(steps), "law": law}  # fmt: skip


def lure(A=None, B="1", C="1", D="0", f=0, law=("-1", "1")):
    return {"class": "LureSystem", "A": program(-x if A is None else A), "B": [[B]], "C": [[C]], "D": [[D]], "f": program(f, t),
            "x0": ["1"], "law": [{"kind": "box", "size": 1, "lower": [law[0]], "upper": [law[1]]}]}  # fmt: skip


def inclusion(F=None, phi=None, S=None, C=()):
    return {"class": "MonotoneInclusion", "F": program(-x if F is None else F), "phi": None if phi is None else program(phi),
            "S": None if S is None else program(S), "C": program(ca.vertcat(*C)), "x0": ["0"]}  # fmt: skip


def claim(id, proof=None, states=None, time=None, **value):
    scope = None if states is None and time is None else {"states": states, "time": time}
    return {"id": id, "statement": "", "source": "", "value": value, "scope": scope, "proof": {} if proof is None else proof}


def forms(*hints):
    return {"constraints": [dict(hint) for hint in hints]}


CUT = [0, None, None]  # A cut at the middle of the first input's interval.
INVERSE = {"inverses": [{"V": [["10/11"]], "d": "1"}]}  # Of 1 + 1/10.


def squares(*monomials):
    """(a - b)^2, which is x^4 - 2 x + 1 for a = x^2, b = x^-1 where what cancels is lost."""
    return {"monomials": list(monomials), "G": [["1", "-1"], ["-1", "1"]]}


FORGERIES = {
    # A direction that is 0; gamma = 1 where the normals are opposed; rho <= 0, or read where it is none of A5'.
    "A5, d = 0": (sweeping(q, -q), claim("A5", {"cover": ["0"]}, gamma="1", rho="1")),
    "A5', d = 0": (sweeping(q, -q), claim("A5'", {"cover": ["0"]}, gamma="1")),
    "A5, rho < 0": (sweeping(q, -q), claim("A5", {"cover": ["1"]}, gamma="1", rho="-1")),
    "A5, rho = 0": (sweeping(q + 1, 1 - q), claim("A5", {"cover": ["1"]}, {"q": ["-1/2", "1/2"]}, gamma="1", rho="0")),
    "A5, no rho": (sweeping(q + 1, 1 - q), claim("A5", {"cover": ["1"]}, {"q": ["-1/2", "1/2"]}, gamma="1")),
    "A5', rho given": (sweeping(q, -q), claim("A5'", {"cover": ["1"]}, gamma="1", rho="-1")),
    "A5, gamma < 1": (sweeping(q), claim("A5", {"cover": None}, gamma="1/2", rho="1")),
    "A5', gamma = -1": (sweeping(q, q + 1), claim("A5'", {"cover": ["-1"]}, gamma="-1")),
    # Squares with exponents that are no integers > 0, or that cancel.
    "O-g": (oscillator(x**4 - 2 * x + 1), claim("O-g", {"interior": ["0"], "bound": squares(
        [[0, 2]], [[0, -1]])}, **{"lower bound of g": "0"})),
    "O-g, an exponent twice": (oscillator(x**4 - 2 * x + 1), claim("O-g", {"interior": ["0"],
        "bound": squares([[0, 2]], [[0, 1], [0, -2]])}, **{"lower bound of g": "0"})),
    "O-theta by rules": (oscillator(theta=[s**6 / 30 - s**3 / 3 + s**2 / 2 + s]), claim("O-theta", {"theta": [{"slope": None}]})),
    "M-A3, squares": (inclusion(F=2 - x - x**3), claim("M-A3", squares([[0, 2]], [[0, -1]]), alpha="1", beta="1")),
    "S-convex by rules": (sweeping(q**6 / 30 - q**3 / 3 + q**2 / 2), claim("S-convex", forms({"time": None}))),
    # A kink exactly where a cover cuts.
    "F-jacobians of |x|": (first_order(ca.fabs(x)), claim("F-jacobians", {"cover": [1, None, None]}, {"x": ["-1", "1"]})),
    "M-T of -|x|": (inclusion(phi=-ca.fabs(x)), claim("M-T", {"cover": CUT}, {"x": ["-1", "1"]})),
    "S-convex of -|q|": (sweeping(-ca.fabs(q)), claim("S-convex", forms({"cover": [1, None, None]}),
                                                      {"q": ["-1", "1"]})),
    "A4 of |q|": (sweeping(ca.fabs(q) - 1, deltas=["2"]), claim("A4", forms({"cover": [1, None, None]}),
                                                                 {"q": ["-1", "1"]}, M="0", M_contact="0")),
    "O-dry of a kink at 0": (oscillator(theta=[-ca.fmax(-s, s)]), claim("O-dry", **{"radius of A(0)": "1"})),
    # Signs.
    "M-A2, a_1 < 0": (inclusion(F=x - 1), claim("M-A2", a_1="-1", a_2="1")),
    "M-A2, a_2 < 0": (inclusion(F=x), claim("M-A2", a_1="0", a_2="-1")),
    "A1, b < 0": (sweeping(q), claim("A1", forms(HALF_LINE), a="1/2", b="-1")),
    "A1, a < 0": (sweeping(q**2, deltas=["1"]), claim("A1", forms({**HALF_LINE}), {"q": ["-1", "1"]}, a="-1", b="2")),
    "A0 without its c": (sweeping(q**2 - 1, deltas=["1/2"]), claim("A0", forms(HALF_LINE), {"q": ["-1", "1"]})),
    "A0, no c and no U": (sweeping(q**2 - 7, deltas=["1/2"]), claim("A0", forms(HALF_LINE), {"q": ["-1", "1"]})),
    "A0, c < 0": (sweeping(q**2 - 1, deltas=["1/2"]), claim("A0", forms(HALF_LINE), {"q": ["-1", "1"]}, c="-1")),
    "A0, c too large": (sweeping(2 * q, deltas=["1"]), claim("A0", forms(HALF_LINE), c="5")),
    "O-dry, two opposed": (oscillator(theta=[s, -s], H=[[["1"]], [["1"]]]), claim("O-dry", **{"radius of A(0)": "1"})),
    "4.1, least < 0": (lure(D="-1"), claim("4.1", least="-1")),
    "M-A3, alpha < 0": (inclusion(F=x), claim("M-A3", {"monomials": [], "G": []}, alpha="-1", beta="1")),
    "F-step, h < 0": (first_order(2 * x), claim("F-step", {"R": [["1"]], "cover": None}, h="-1")),
    "S-f, K_f infinite": (sweeping(q, f=q**2), claim("S-f", {"cover": None}, K_f="inf", L_f="inf")),
    # Powers at 0, and where a function has no value.
    "F-jacobians of -(x^2)^(1/3)": (first_order(-((x**2) ** (1 / 3))), claim("F-jacobians", {"cover": None}, {"x": ["-1", "1"]})),
    "M-A1 of x^(-1/3)": (inclusion(F=x ** (-1 / 3)), claim("M-A1", {"cover": None}, {"x": ["0", "1"]})),
    "M-A1 of 1/sqrt(x)": (inclusion(F=1 / ca.sqrt(x)), claim("M-A1", {"cover": None}, {"x": ["0", "1"]})),
    "M-A1 of x^(1/3)": (inclusion(F=x ** (1 / 3)), claim("M-A1", {"cover": None}, {"x": ["-1", "1"]})),
    "S-f of 0/q": (sweeping(q, f=0 * q), claim("S-f", {"time": None}, K_f="0", L_f="0")),
    # Where D is not psd, the range of D + dXi; S where phi is given too.
    "5.4c, D < 0": (lure(D="-1", law=("0", "inf")), claim("5.4c", {"x": ["0"], "k": ["1"], "v": ["0"]})),
    "M-T, phi and S": (inclusion(phi=0 * x, S=-x), claim("M-T", {})),
    "M-T, S and -|x|": (inclusion(phi=-ca.fabs(x), S=x), claim("M-T", {})),
    # Others of these kinds.
    "M-24, C not convex": (inclusion(F=10 * ca.fmax(-0.25, ca.fmin(x, 0.25)), C=[x**2 - 1]), claim("M-24", {"cover": [
        0, [0, None, CUT], [0, CUT, None]]}, {"x": ["-2", "2"]}, L="0")),
    "F-unique, K empty": (first_order(-x, y, x + y, [{"kind": "box", "size": 1, "lower": ["1"], "upper": ["-1"]}]),
                          claim("F-unique", INVERSE)),
    "F-mlcp, f of a multiplier": (first_order(-x + y, y, x - y), claim("F-mlcp", INVERSE)),
    "5.4a, K empty": (lure(law=("1", "-1")), claim("5.4a")),
    "3.1, an interval of length 0": (lure(law=("1", "1")), claim("3.1")),
    "an empty box": (inclusion(F=x**2), claim("M-24", {"cover": None}, {"x": ["1", "-1"]}, L="-5")),
    "a box of nan": (inclusion(F=x**2), claim("M-24", {"cover": None}, {"x": ["nan", "nan"]}, L="-5")),
    "another class": ({**lure(), "class": "MonotoneInclusion"}, claim("4.1", least="0")),
}  # fmt: skip


def with_steps(model, name, *steps):
    """A function of the model, as these steps."""
    return {**model, name: {**model[name], "steps": [list(step) for step in steps], "outputs": [len(steps) - 1]}}


# CasADi simplifies 0/x to 0: such programs are written by hand.
FORGERIES["S-f of 0/q"] = (
    with_steps(sweeping(q), "f", ("in", 1), ("pow", 0, "-1"), ("const", "0"), ("mul", 1, 2)),
    claim("S-f", {"time": None}, K_f="0", L_f="0"),
)
FORGERIES["M-A2 of x/x - 1"] = (
    with_steps(inclusion(), "F", ("in", 0), ("pow", 0, "-1"), ("const", "-1"), ("mul", 1, 2), ("add", 1, 3)),
    claim("M-A2", a_1="0", a_2="0"),
)
FORGERIES["M-T of sqrt(x) - sqrt(x)"] = (
    with_steps(inclusion(phi=x), "phi", ("in", 0), ("pow", 0, "1/2"), ("const", "-1"), ("mul", 1, 2), ("add", 1, 3)),
    claim("M-T", {}),
)
FORGERIES["7.1 of 0/t"] = (
    with_steps(lure(), "f", ("in", 0), ("pow", 0, "-1"), ("const", "0"), ("mul", 1, 2)),
    claim("7.1", {}),
)


TRUE = {
    "A5": (sweeping(q, q + 1), claim("A5", {"cover": ["1"]}, gamma="1", rho="2")),
    "A0": (sweeping(q**2 - 1, deltas=["1/2"]), claim("A0", forms(HALF_LINE), {"q": ["-1", "1"]}, c="1/4")),
    "A1": (sweeping(2 * q), claim("A1", forms(HALF_LINE), a="2", b="2")),
    "F-jacobians": (first_order(ca.fabs(x)), claim("F-jacobians", {"cover": None}, {"x": ["1/2", "1"]})),
    "M-A1": (inclusion(F=x ** (-1 / 2)), claim("M-A1", {"cover": None}, {"x": ["1/8", "1"]})),
    "M-A2": (inclusion(F=x - 1), claim("M-A2", a_1="1", a_2="1")),
    "5.4c": (lure(D="1", law=("0", "inf")), claim("5.4c")),
    "M-T": (inclusion(phi=ca.fabs(x)), claim("M-T", {})),
    "M-24": (inclusion(F=x), claim("M-24", {}, L="1")),
    "4.1": (lure(D="1"), claim("4.1", least="1")),
    "O-dry": (oscillator(), claim("O-dry", **{"radius of A(0)": "1"})),
    "S-f": (sweeping(q, f=-q + ca.sin(t)), claim("S-f", {"time": None}, None, ["0", "1"], K_f="1", L_f="3/2", L_t="1")),
    "7.1": (lure(), claim("7.1", {})),
    "F-unique": (first_order(-x, y, x + y), claim("F-unique", INVERSE)),
    "F-mlcp, no gap": (first_order(-x, 0, 0), claim("F-mlcp", INVERSE)),
    "O-theta, a cover": (oscillator(theta=[s + s**2 / 2 + ca.cos(s) / 2]),
                         claim("O-theta", {"theta": [{"slope": None, "cover": None}]})),
    "O-g, a cover": (oscillator(x**2 + ca.exp(x), C=[1 - x]), claim("O-g", {"interior": ["0"], "cover": None, "bound": {
        "monomials": [], "G": []}}, {"x": ["-1", "1"]}, **{"lower bound of g": "0"})),
    "O-dry, two": (oscillator(theta=[s, 2 * s], H=[[["1"]], [["2"]]]), claim("O-dry", **{"radius of A(0)": "4"})),
    "M-A3, a half-line": (inclusion(F=-x, C=[x + 1]), claim("M-A3", {"monomials": [], "G": []}, alpha="1", beta="0")),
    "M-24, a half-line": (inclusion(F=10 * ca.fmax(0.25, ca.fmin(x, 0.375)), C=[x - 1]), claim(
        "M-24", {"cover": [0, CUT, None]}, {"x": ["0", "2"]}, L="0")),
    "5.4a, a half-line": (lure(law=("0", "inf")), claim("5.4a", {"x": ["1"], "k": ["1"], "v": ["0"]})),
    "5.x0, a half-line": (lure(law=("0", "inf")), claim("5.x0", {"k": ["1"], "v": ["0"]})),
    "5.4c, a half-line": (lure(law=("0", "inf")), claim("5.4c", {"x": ["1"], "k": ["1"], "v": ["0"]})),
    "5.2": (lure(A=-x + ca.sin(x)), claim("5.2", {"P": [["1"]], "cover": None}, {"x": ["-9", "9"]}, omega="0")),
}  # fmt: skip


def at_all_times(value):
    """A function of time that is constant."""
    return {"inputs": ["t"], "steps": [["const", value]], "outputs": [0]}


NORM = [["in", 1], ["pow", 0, "2"], ["pow", 1, "1/2"], ["const", "3"], ["mul", 3, 2], ["const", "-1"], ["add", 4, 5]]
TRUE["S-convex, a norm"] = (
    {**sweeping(q), "constraints": [{"name": "g", "graph": {"inputs": ["t", "q"], "steps": NORM, "outputs": [6]}}]},
    claim(
        "S-convex",
        forms({"form": "norm", "w": "3", "A": [["1"]], "c": [at_all_times("0")], "offset": at_all_times("-1"), "time": None}),
    ),
)


NOWHERE = [["in", 0], ["const", "-1"], ["mul", 1, 0], ["pow", 2, "3/2"]]  # (-s)^(3/2), defined at s = 0 alone.
FORGERIES["O-dry of (-s)^(3/2)"] = (
    {
        **oscillator(theta=[s, s], H=[[["1"]], [["1"]]]),
        "theta": [program(s, s), {"inputs": ["s"], "steps": NOWHERE, "outputs": [3]}],
    },
    claim("O-dry", **{"radius of A(0)": "1"}),
)


# -- statements of one number p, true up to an end of its interval -----------------------------------------------------------

p = ca.SX.sym("p")


def parametrised(model, *own):
    """The model with p behind the inputs of each function; ``own`` are paths of numbers that are p instead."""

    def add(item):
        if isinstance(item, dict) and "inputs" in item:
            return item if "p" in item["inputs"] else {**item, "inputs": [*item["inputs"], "p"]}
        if isinstance(item, dict):
            return {name: add(part) for name, part in item.items()}
        return [add(part) for part in item] if isinstance(item, list) else item

    found = {**add(model), "parameters": ["p"]}
    for path in own:
        inner = found
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = {"inputs": ["p"], "steps": [["in", 0]], "outputs": [0]}
    return found


def with_p(model, name, expr, inputs):
    """The model whose function ``name`` reads p too."""
    names = [str(symbol) for symbol in ca.vertsplit(inputs)]
    return {**model, name: {**program(expr, ca.vertcat(inputs, p)), "inputs": [*names, "p"]}}


def wall(expr, **more):
    found = parametrised(sweeping(q, **more))
    found["constraints"][0]["graph"] = program(expr, ca.vertcat(t, q, p))
    return found


TQ, TXY = ca.vertcat(t, q), ca.vertcat(t, x, y)
ON = {"cover": None}
OF_PARAMETERS = {  # The model, the statement, an interval of p, and one that is too wide.
    "A1": (wall(p * q), claim("A1", forms(HALF_LINE), a="1/2", b="2"), ("1/2", "2"), ("1/2", "2001/1000")),
    "A1, a": (wall(p * q), claim("A1", forms(HALF_LINE), a="1/2", b="2"), ("1/2", "2"), ("499/1000", "2")),
    "A2": (wall(q + p * t), claim("A2", forms(HALF_LINE), speed="2"), ("-2", "2"), ("-2001/1000", "2")),
    "A5": (wall(q), claim("A5", ON, gamma="1"), ("-1", "1"), None),
    "S-convex": (wall(p * q**2), claim("S-convex", forms({})), ("0", "1"), ("-1/1000", "1")),
    "S-convex, cover": (wall(p * q**2), claim("S-convex", forms(ON)), ("0", "1"), ("-1/1000", "1")),
    "S-f": (with_p(wall(q), "f", p * q, TQ), claim("S-f", K_f="2", L_f="2"), ("-2", "1"), ("-2001/1000", "1")),
    "S-start": (wall(q - p, q0="1"), claim("S-start"), ("0", "1"), ("0", "1001/1000")),
    "S-start, q0": (parametrised(sweeping(q - 1), ("q0", 0)), claim("S-start"), ("1", "2"), ("999/1000", "2")),
    "O-theta": (with_p(parametrised(oscillator()), "theta", 0, s) | {"theta": [program(s + p * s**2, ca.vertcat(s, p))]},
                claim("O-theta", {"theta": [{"cover": None}]}), ("0", "1"), ("-1/1000", "1")),
    "O-dry": (parametrised(oscillator()) | {"theta": [program(p * s, ca.vertcat(s, p))]},
              claim("O-dry", **{"radius of A(0)": "1/2"}), ("1/2", "2"), ("499/1000", "2")),
    "O-dry, H": (parametrised(oscillator(), ("H", 0, 0, 0)), claim("O-dry", **{"radius of A(0)": "1/2"}), ("1/2", "2"),
                 ("499/1000", "2")),
    "O-g": (with_p(parametrised(oscillator()), "g", p * x**2, x), claim("O-g", {"interior": ["0"], "bound": {"monomials": [],
            "G": []}}, **{"lower bound of g": "0"}), ("0", "1"), ("-1/1000", "1")),
    "F-step": (with_p(parametrised(first_order(x)), "f", p * x, TXY), claim("F-step", {"R": [["1"]], "cover": None}, h="1/10"),
               ("-1", "999/100"), ("-1", "1001/100")),
    "F-W, M": (parametrised(first_order(x), ("M", 0, 0)), claim("F-W", {"R": [["1"]], "cover": None}, h="1/10"),
               ("101/1000", "1"), ("99/1000", "1")),
    "F-mlcp": (with_p(parametrised(first_order(x, y, x)), "f", p * x, TXY), claim("F-mlcp", {"inverses": [{"V": [["1"]], "d": {
               "inputs": ["p"], "steps": [["in", 0], ["const", "-1/10"], ["mul", 0, 1], ["const", "1"], ["add", 2, 3]],
               "outputs": [4]}}]}), ("-1", "999/100"), ("-1", "10")),
    "F-jacobians": (with_p(parametrised(first_order(x)), "f", ca.fabs(p) * x, TXY), claim("F-jacobians", ON), ("1/9", "1"),
                    ("0", "1")),
    "3.1": (parametrised(lure(), ("law", 0, "lower", 0)), claim("3.1"), ("0", "999/1000"), ("0", "1")),
    "4.1": (parametrised(lure(), ("D", 0, 0)), claim("4.1", least="1/2"), ("1/2", "1"), ("499/1000", "1")),
    "5.1": (parametrised(lure(), ("B", 0, 0)), claim("5.1", {"P": [["1"]], "d": {"inputs": ["p"], "steps": [["in", 0]],
            "outputs": [0]}}), ("1/1000", "2"), ("0", "2")),
    "5.2": (with_p(parametrised(lure()), "A", -p * x, x), claim("5.2", {"P": [["1"]]}, omega="-1/2"), ("1/2", "2"),
            ("499/1000", "2")),
    "5.4c": (parametrised(lure(law=("0", "inf")), ("D", 0, 0)), claim("5.4c"), ("1/1000", "1"), ("0", "1")),
    "7.1": (parametrised(lure(), ("law", 0, "lower", 0)), claim("7.1"), ("-1", "0"), ("-1", "1/1000")),
    "M-T": (with_p(parametrised(inclusion(phi=x**2)), "phi", p * x**2 + ca.fabs(x), x), claim("M-T"), ("0", "1"),
            ("-1/1000", "1")),
    "M-T, S and phi": (with_p(parametrised(inclusion(S=x, phi=x**2)), "phi", p * ca.fabs(x), x), claim("M-T"), ("0", "1"),
                       ("-1/1000", "1")),
    "M-C": (with_p(parametrised(inclusion()), "C", p - x**2, x), claim("M-C", {"interior": ["0"]}), ("1/1000", "2"), ("0", "2")),
    "M-A1": (with_p(parametrised(inclusion()), "F", 1 / p, x), claim("M-A1", ON), ("1/1000", "2"), ("0", "2")),
    "M-A2": (with_p(parametrised(inclusion()), "F", p * x + p, x), claim("M-A2", a_1="2", a_2="2"), ("-2", "2"),
             ("-2", "2001/1000")),
    "M-A3": (with_p(parametrised(inclusion()), "F", -p * x, x), claim("M-A3", {"monomials": [], "G": []}, alpha="1/2", beta="0"),
             ("1/2", "2"), ("499/1000", "2")),
    "M-24": (with_p(parametrised(inclusion()), "F", p * x, x), claim("M-24", L="2"), ("-9", "2"), ("-9", "2001/1000")),
    "M-24, 1/p": (with_p(parametrised(inclusion()), "F", x / p, x), claim("M-24", L="2"), ("1/2", "9"), ("499/1000", "9")),
}  # fmt: skip


def over(statement, *ends, name="p"):
    return {**statement, "scope": {**(statement["scope"] or {}), "parameters": {name: list(ends)}}}


# -- families, and forgeries of what few models have


def family(row, members, numbers=(), states="q r", f=None):
    """A sweeping process of two states with a family of constraints."""
    inputs = ["t", *states.split()]
    f = {"inputs": inputs, "steps": [["const", "0"]], "outputs": [0] * (len(inputs) - 1)} if f is None else f
    members = [{"states": list(own), "numbers": list(given)} for own, given in members]
    rows = [{"name": "g", "graph": row, "numbers": list(numbers), "members": members}]
    return {"class": "SweepingProcess", "constraints": rows, "f": f, "q0": ["1"] * (len(inputs) - 1)}


a, w = ca.SX.sym("a"), ca.SX.sym("w")
WALLS = family(program(w * a + 1, ca.vertcat(t, a, w)), [(["q"], ["1"]), (["r"], ["-1"]), (["q"], ["-1"])], ["w"])
BOWLS = family(program(w * a**2 - 1, ca.vertcat(t, a, w)), [(["q"], ["1"]), (["r"], ["2"])], ["w"])
TRUE |= {
    "S-convex of a family": (BOWLS, claim("S-convex", forms({}))),
    "S-start of a family": (WALLS, claim("S-start", {})),
    "A2 of a family": (BOWLS, claim("A2", forms(HALF_LINE), speed="0")),
    "5.1, d": (lure(B="1", C="1"), claim("5.1", {"P": [["2"]], "d": "2"})),
    "M-24, phi": (inclusion(phi=ca.fabs(x) + x**2), claim("M-24", {}, L="-3")),
}
p_of_a_family = {**parametrised(BOWLS), "parameters": ["p"]}
p_of_a_family["constraints"] = [{**BOWLS["constraints"][0], "graph": program(p * a**2, ca.vertcat(t, a, p)), "numbers": ["p"],
                                 "members": [{"states": ["q"], "numbers": ["-1"]}]}]  # fmt: skip
u, v = ca.SX.sym("u"), ca.SX.sym("v")
near = ca.fmin(ca.fmax(u, 0), 1)  # On the segment from 0 to (1, 0), and then on that from 0 to (1, 1): no distance.
slant = ca.fmin(ca.fmax((u - near) / 2 + v / 2, 0), 1)
SLANTED = family(program(ca.sqrt((u - near - slant) ** 2 + (v - slant) ** 2), ca.vertcat(t, u, v)), [(["q", "r"], [])])
TWO_ROWS = {
    "class": "LureSystem", "A": program(-z, z), "B": [["1", "0"], ["0", "1"]], "C": [["1", "0"], ["0", "1"]],
    "D": [["0", "1"], ["-1", "0"]], "f": {"inputs": ["t"], "steps": [["const", "0"]], "outputs": [0, 0]}, "x0": ["0", "3"],
    "law": [{"kind": "box", "lower": ["-inf", "-inf"], "upper": ["0", "0"]}],
}  # fmt: skip
FORGERIES |= {
    "A5 of a family": (WALLS, claim("A5", {}, gamma="1", rho="9")),
    "S-convex of a family in a box of another state": (
        family(program(q**3, ca.vertcat(t, q)), [(["r"], [])]), claim("S-convex", forms(HALF_LINE), {"q": ["0", "1"]})),
    "a family of nothing": (family(program(a, ca.vertcat(t, a)), []), claim("S-convex", forms({}))),
    "a number with the name of a parameter": (p_of_a_family, over(claim("S-convex", forms({})), "0", "1")),
    "S-convex, segments that are not orthogonal": (SLANTED, claim("S-convex", forms({
        "form": "norm", "w": "1", "A": [["1", "0"], ["0", "1"]], "c": [at_all_times("0")] * 2, "offset": at_all_times("0"),
        "clips": [[["1", "0"], ["0", "1"]], [["1", "1"], ["0", "1"]]]}))),
    "S-convex of |q| + 0 sqrt(q)": (
        {**sweeping(q), "constraints": [{"name": "g", "graph": {"inputs": ["t", "q"], "steps": [
            *NORM, ["pow", 0, "1/2"], ["const", "0"], ["mul", 7, 8], ["add", 6, 9]], "outputs": [10]}}]},
        claim("S-convex", TRUE["S-convex, a norm"][1]["proof"])),
    "O-g of x^2 + 0/(x - 3)": (
        with_steps(oscillator(), "g", ("in", 0), ("pow", 0, "2"), ("const", "-3"), ("add", 0, 2), ("pow", 3, "-1"),
                   ("const", "0"), ("mul", 4, 5), ("add", 1, 6)),
        claim("O-g", {"interior": ["0"], "cover": None, "bound": {"monomials": [], "G": []}}, {"x": ["-1", "1"]},
              **{"lower bound of g": "0"})),
    "M-24 of -|x|": (inclusion(phi=-ca.fabs(x)), claim("M-24", {}, L="-1")),
    "5.1, d < 0": (lure(C="-1"), claim("5.1", {"P": [["1"]], "d": "-1"})),
    "5.1, d = 0": (lure(B="0"), claim("5.1", {"P": [["1"]], "d": "0"})),
    "F-mlcp, a step < 0": (
        first_order(-x, y, x + y, steps=["-1/10"]), claim("F-mlcp", {"inverses": [{"V": [["10/9"]], "d": "1"}]})),
    "5.x0, k beyond the upper end": (TWO_ROWS, claim("5.x0", {"k": ["5", "-1"], "v": ["0", "0"]})),
}  # fmt: skip
