"""False statements with made-up proofs: the program of certificates answers none of them with yes."""

from __future__ import annotations

import json
import subprocess
import sys

import casadi as ca

from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.hints import straight_line_program

t, s, x, y, q = (ca.SX.sym(name) for name in "tsxyq")
z = ca.SX.sym("z", 2)
HALF_LINE = {"form": "box", "cover": None}


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


def lure(A=None, B="1", C="1", D="0", f=0, law=("-1", "1"), phi=None):
    blocks = [] if phi is not None else [{"kind": "box", "size": 1, "lower": [law[0]], "upper": [law[1]]}]
    return {"class": "LureSystem", "A": program(-x if A is None else A), "B": [[B]], "C": [[C]], "D": [[D]], "f": program(f, t),
            "x0": ["1"], "law": blocks, "phi": None if phi is None else program(phi, y)}  # fmt: skip


def inclusion(F=None, phi=None, S=None, C=(), switches=()):
    return {"class": "MonotoneInclusion", "F": program(-x if F is None else F), "phi": None if phi is None else program(phi),
            "S": None if S is None else program(S), "C": program(ca.vertcat(*C)), "x0": ["0"],
            "switches": [[[str(w)], program(a)] for w, a in switches]}  # fmt: skip


def claim(id, proof=None, states=None, time=None, **value):
    scope = None if states is None and time is None else {"states": states, "time": time}
    return {"id": id, "statement": "", "source": "", "value": value, "scope": scope, "proof": {} if proof is None else proof}


def forms(*hints):
    return {"constraints": [dict(hint) for hint in hints]}


CUT = [0, None, None]  # A cut at the middle of the first input's interval.
CURVATURE = {"monomials": [[[-1, 1], [0, 1]]], "G": [["12"]]}  # y^2 12 x^2


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
    "O-g": (oscillator(x**4 - 2 * x + 1), claim("O-g", {"interior": ["0"], "squares": CURVATURE, "bound": squares(
        [[0, 2]], [[0, -1]])}, **{"lower bound of g": "0"})),
    "O-g, an exponent twice": (oscillator(x**4 - 2 * x + 1), claim("O-g", {"interior": ["0"], "squares": CURVATURE,
        "bound": squares([[0, 2]], [[0, 1], [0, -2]])}, **{"lower bound of g": "0"})),
    "O-theta, squares": (oscillator(theta=[s**6 / 30 - s**3 / 3 + s**2 / 2 + s]), claim("O-theta", {"theta": [
        {"slope": None, "squares": [squares([[0, 2]], [[0, -1]]), {"monomials": [], "G": []}]}]})),
    "M-A3, squares": (inclusion(F=2 - x - x**3), claim("M-A3", squares([[0, 2]], [[0, -1]]), alpha="1", beta="1")),
    "S-convex, squares": (sweeping(q**6 / 30 - q**3 / 3 + q**2 / 2), claim("S-convex", forms({
        "form": "rules", "time": None, "squares": squares([[-2, 1], [1, 2]], [[-2, 1], [1, -1]])}))),
    # A kink exactly where a cover cuts.
    "F-jacobians of |x|": (first_order(ca.fabs(x)), claim("F-jacobians", {"cover": [1, None, None]}, {"x": ["-1", "1"]})),
    "M-T of -|x|": (inclusion(phi=-ca.fabs(x)), claim("M-T", {"cover": CUT}, {"x": ["-1", "1"]})),
    "S-convex of -|q|": (sweeping(-ca.fabs(q)), claim("S-convex", forms({"form": "box", "cover": [1, None, None]}),
                                                      {"q": ["-1", "1"]})),
    "A4 of |q|": (sweeping(ca.fabs(q) - 1, deltas=["2"]), claim("A4", forms({"form": "box", "cover": [1, None, None]}),
                                                                 {"q": ["-1", "1"]}, M="0", M_contact="0")),
    "O-dry of a kink at 0": (oscillator(theta=[-ca.fmax(-s, s)]), claim("O-dry", **{"radius of A(0)": "1"})),
    # Signs.
    "M-A2, a_1 < 0": (inclusion(F=x - 1), claim("M-A2", a_1="-1", a_2="1")),
    "M-A2, a_2 < 0": (inclusion(F=x), claim("M-A2", a_1="0", a_2="-1")),
    "A1, b < 0": (sweeping(q), claim("A1", forms(HALF_LINE), a="1/2", b="-1")),
    "A1, a < 0": (sweeping(q**2, deltas=["1"]), claim("A1", forms({**HALF_LINE}), {"q": ["-1", "1"]}, a="-1", b="2")),
    "A0 without its c": (sweeping(q**2 - 1, deltas=["1/2"]), claim("A0", forms({**HALF_LINE, "b": "2"}), {"q": ["-1", "1"]})),
    "A0, c < 0": (sweeping(q**2 - 1, deltas=["1/2"]), claim("A0", forms({**HALF_LINE, "b": "2"}), {"q": ["-1", "1"]}, c="-1")),
    "A0, b < 0": (sweeping(2 * q, deltas=["1"]), claim("A0", forms({**HALF_LINE, "b": "-2"}), c="5")),
    "O-dry, two opposed": (oscillator(theta=[s, -s], H=[[["1"]], [["1"]]]), claim("O-dry", **{"radius of A(0)": "1"})),
    "4.1, least < 0": (lure(D="-1"), claim("4.1", least="-1")),
    "M-A3, alpha < 0": (inclusion(F=x), claim("M-A3", {"monomials": [], "G": []}, alpha="-1", beta="1")),
    "F-step, h < 0": (first_order(2 * x), claim("F-step", {"inverse": [["1"]], "cover": None}, h="-1")),
    "S-f, K_f infinite": (sweeping(q, f=q**2), claim("S-f", {"cover": None}, K_f="inf", L_f="inf")),
    # Powers at 0, and where a function has no value.
    "F-jacobians of -(x^2)^(1/3)": (first_order(-((x**2) ** (1 / 3))), claim("F-jacobians", {"cover": None}, {"x": ["-1", "1"]})),
    "M-A1 of x^(-1/3)": (inclusion(F=x ** (-1 / 3)), claim("M-A1", {"cover": None}, {"x": ["0", "1"]})),
    "M-A1 of log x": (inclusion(F=ca.log(x)), claim("M-A1", {"cover": None}, {"x": ["0", "1"]})),
    "M-A1 of x^(1/3)": (inclusion(F=x ** (1 / 3)), claim("M-A1", {"cover": None}, {"x": ["-1", "1"]})),
    "S-f of 0/q": (sweeping(q, f=0 * q), claim("S-f", {"time": None}, K_f="0", L_f="0")),
    # Where D is not psd, the range of D + dXi; S where phi is given too.
    "5.4c, D = -1": (lure(D="-1", phi=y**2 / 2), claim("5.4c")),
    "5.4c, D < 0": (lure(D="-1", law=("0", "inf")), claim("5.4c", {"x": ["0"], "k": ["1"], "y": ["1"], "v": ["0"]})),
    "M-T, phi and S": (inclusion(phi=0 * x, S=-x), claim("M-T", {})),
    "M-T, phi and a switch": (inclusion(phi=0 * x, switches=[(-1, x)]), claim("M-T", {})),
    # Others of these kinds.
    "M-24, C not convex": (inclusion(F=10 * ca.fmax(-0.25, ca.fmin(x, 0.25)), C=[x**2 - 1]), claim("M-24", {"cover": [
        0, [0, None, CUT], [0, CUT, None]]}, {"x": ["-2", "2"]}, L="0")),
    "F-unique, K empty": (first_order(-x, y, x + y, [{"kind": "box", "size": 1, "lower": ["1"], "upper": ["-1"]}]),
                          claim("F-unique", {"inverses": [[["10/11"]]], "T": [None]})),
    "F-mlcp, f of a multiplier": (first_order(-x + y, y, x - y), claim("F-mlcp", {"inverses": [[["10/11"]]], "T": [None]})),
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
FORGERIES["M-T of log x - log x"] = (
    with_steps(inclusion(phi=x), "phi", ("in", 0), ("log", 0), ("const", "-1"), ("mul", 1, 2), ("add", 1, 3)),
    claim("M-T", {}),
)
FORGERIES["7.1 of 0 log t"] = (
    with_steps(lure(), "f", ("in", 0), ("log", 0), ("const", "0"), ("mul", 1, 2)),
    claim("7.1", {}),
)


def test_no_forgery_of_the_list_is_answered_yes():
    answers = {name: verify.answer(*pair) for name, pair in FORGERIES.items()}
    assert {name: answer for name, answer in answers.items() if answer[0] not in ("no", "not checkable")} == {}
    assert not any("not well formed" in text for _, text in answers.values())


TRUE = {
    "A5": (sweeping(q, q + 1), claim("A5", {"cover": ["1"]}, gamma="1", rho="2")),
    "A0": (sweeping(q**2 - 1, deltas=["1/2"]), claim("A0", forms({**HALF_LINE, "b": "2"}), {"q": ["-1", "1"]}, c="1/4")),
    "A1": (sweeping(2 * q), claim("A1", forms(HALF_LINE), a="2", b="2")),
    "F-jacobians": (first_order(ca.fabs(x)), claim("F-jacobians", {"cover": None}, {"x": ["1/2", "1"]})),
    "M-A1": (inclusion(F=x ** (-1 / 3)), claim("M-A1", {"cover": None}, {"x": ["1/8", "1"]})),
    "M-A2": (inclusion(F=x - 1), claim("M-A2", a_1="1", a_2="1")),
    "5.4c": (lure(D="1", phi=y**2 / 2), claim("5.4c")),
    "M-T": (inclusion(phi=ca.fabs(x)), claim("M-T", {})),
    "M-24": (inclusion(F=x), claim("M-24", {}, L="1")),
    "4.1": (lure(D="1"), claim("4.1", least="1")),
    "O-dry": (oscillator(), claim("O-dry", **{"radius of A(0)": "1"})),
    "S-f": (sweeping(q, f=-q + ca.sin(t)), claim("S-f", {"time": None}, None, ["0", "1"], K_f="1", L_f="3/2", L_t="1")),
    "7.1": (lure(), claim("7.1", {})),
    "F-unique": (first_order(-x, y, x + y), claim("F-unique", {"inverses": [[["10/11"]]], "T": [None]})),
}


def test_the_true_ones_beside_them_are_proved():
    answers = {name: verify.answer(*pair) for name, pair in TRUE.items()}
    assert {name: answer for name, answer in answers.items() if answer[0] != "yes"} == {}


def test_the_sentence_is_made_from_the_numbers():
    model, statement = TRUE["M-A2"]
    lied = {**statement, "statement": "F is bounded", "why": "yes", "source": "A5 yes"}
    assert verify.answer(model, lied) == ("yes", "|v| <= 1 + 1 |x| for all x and all v in F(x) - S(x)")
    wider = {**statement, "value": {"a_1": "4/3", "a_2": "123456789123456789/100000000000000000"}}
    assert verify.answer(model, wider)[1].startswith("|v| <= 4/3 + 1.23456789123457 |x|")  # Rounded up.
    model, statement = TRUE["M-A1"]
    assert "x in [1/8, 1]" in verify.answer(model, statement)[1]


JUNK = (None, True, 0, -1, 1.5, float("nan"), float("inf"), "", "x", "nan", "1e9", "1/0", "١", [], {}, [[]], [None], {"a": []})


def places(item, path=()):
    yield path
    if isinstance(item, dict | list):
        for key, part in item.items() if isinstance(item, dict) else enumerate(item):
            yield from places(part, (*path, key))


def replaced(item, path, new):
    if not path:
        return new
    copy = dict(item) if isinstance(item, dict) else list(item)
    copy[path[0]] = replaced(item[path[0]], path[1:], new)
    return copy


def test_wrong_types_are_no_and_never_an_exception():
    for pair in TRUE.values():
        for path in list(places(list(pair)))[1:]:
            for junk in JUNK:
                kind, text = verify.answer(*replaced(list(pair), path, junk))
                assert kind in ("yes", "no", "not checkable")
                assert "\n" not in text


def written(tmp_path, **changes):
    """The output of the program for a certificate with changes."""
    model, statement = TRUE["M-A2"]
    certificate = {"format": verify.FORMAT, "title": "a title", "hash": verify.digest(model), "model": model}
    certificate |= {"statements": [statement]} | changes
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(certificate))
    return subprocess.run([sys.executable, "-I", "-S", verify.__file__, str(path)], capture_output=True, text=True)


HIDDEN = "\nA5           yes: everything\r\x1b[2K\u202eA5\u2028"


def test_what_a_certificate_calls_itself_is_escaped(tmp_path):
    model, statement = TRUE["M-A2"]
    named = {**model, "class": HIDDEN}
    unproved = {**statement, "proof": None, "why": HIDDEN}
    cases = [{"title": HIDDEN}, {"statements": [unproved]}, {"statements": [{**statement, "id": HIDDEN}]},
             {"model": named, "hash": verify.digest(named)}, {"statements": [{**statement, "statement": HIDDEN}]}]  # fmt: skip
    for change in cases:
        found = written(tmp_path, **change)
        assert not found.stderr
        assert all(32 <= ord(letter) < 127 for line in found.stdout.splitlines() for letter in line)
        assert not any(line.startswith("A5") for line in found.stdout.splitlines())


def test_an_input_with_a_strange_name_is_escaped(tmp_path):
    model, statement = TRUE["M-A1"]
    model = json.loads(json.dumps(model).replace('"x"', json.dumps(HIDDEN)))
    statement = json.loads(json.dumps(statement).replace('"x"', json.dumps(HIDDEN)))
    found = written(tmp_path, model=model, hash=verify.digest(model), statements=[statement])
    assert "1 yes, 0 no" in found.stdout
    assert not any(line.startswith("A5") for line in found.stdout.splitlines())


def test_ids_of_other_types_and_unknown_ones(tmp_path):
    ids = [[], ["A5"], {}, None, 5, "A6", True]
    found = written(tmp_path, statements=[*({**TRUE["M-A2"][1], "id": id} for id in ids), None, [], "A5"])
    assert not found.stderr
    assert "0 yes" in found.stdout


def test_a_name_twice_in_an_object_is_refused(tmp_path):
    written(tmp_path)
    path = tmp_path / "certificate.json"
    path.write_text(path.read_text().replace('"title"', '"title": "another", "title"', 1))
    assert "a name stands twice" in verify.main(str(path))


def test_files_that_are_no_certificates(tmp_path):
    path = tmp_path / "other.json"
    for text in ("[" * 100000, '{"a": ' * 100000, "\ud800", "NaN", ""):
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        assert "is no certificate" in verify.main(str(path))


def test_programs_that_take_for_ever_are_not_read():
    squared = [["in", 0], *(["mul", k, k] for k in range(60))]
    model = {**inclusion(), "F": {"inputs": ["x"], "steps": [*squared, ["add", 1, 60]], "outputs": [61]}}
    assert verify.answer(model, claim("M-A2", a_1="1", a_2="1"))[0] != "yes"
    long = [["in", 0], ["const", "3"], *(["mul", k, k] for k in range(1, 60))]
    model = {**inclusion(), "F": {"inputs": ["x"], "steps": long, "outputs": [60]}}
    assert verify.answer(model, claim("M-A2", a_1="1", a_2="1"))[0] != "yes"
    model = with_steps(inclusion(), "F", ("in", 0), ("pow", 0, "1000000000000"))
    assert verify.answer(model, claim("M-A1", {"cover": None}, {"x": ["2", "3"]}))[0] != "yes"


# -- a search at random, and the checker with a premise dropped --------------------------------------------------------------


def test_no_forgery_is_found_at_random():
    from search import forgeries

    found, accepted = [], 0
    for rule in verify.STATEMENTS:
        assert forgeries.originals()[rule], rule
        more, yes = forgeries.search(rule, 10, seed=5, seconds=0.3)
        found, accepted = found + more, accepted + yes
    assert not found, found[0]
    assert accepted > 30  # Many changes leave a statement true: the oracle has something to look at.


def test_the_oracle_finds_no_fault_with_what_is_true():
    from search import falsity, forgeries

    for pairs in forgeries.originals().values():
        assert not falsity.find(*pairs[0], seed=1)
    assert not any(falsity.find(*pair) for pair in TRUE.values())


SEEN = "O-g; O-theta, squares; M-A3, squares; M-T of -|x|; O-dry, two opposed; 5.4c, D = -1; A5, d = 0; M-T, phi and S"
SEEN += "; M-24, C not convex; M-A2 of x/x - 1; 4.1, least < 0; 7.1 of 0 log t; F-unique, K empty"


def test_the_oracle_sees_that_forgeries_are_false():
    from search import falsity

    assert [name for name in SEEN.split("; ") if not any(falsity.find(*FORGERIES[name], seed=k) for k in range(4))] == []


def test_the_search_finds_what_a_checker_without_a_premise_lets_pass():
    from search import forgeries

    tried = list(forgeries.mutants(("dry", "steps_grow", "feedthrough")))
    assert len(tried) >= 6
    missed = []
    for where, module in tried:
        rules = forgeries.rules_of(where.split()[0])
        if not any(forgeries.search(rule, 1000, 0, module)[0] for rule in rules):
            missed.append(where)
    assert not missed
