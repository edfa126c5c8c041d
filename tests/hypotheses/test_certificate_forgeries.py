"""False statements with made-up proofs: the program of certificates answers none of them with yes."""

from __future__ import annotations

import json
import subprocess
import sys

import casadi as ca
import mpmath
import pytest
from search import falsity, forgeries
from search.claims import (
    FORGERIES,
    HALF_LINE,
    TRUE,
    claim,
    forms,
    inclusion,
    lure,
    oscillator,
    program,
    q,
    sweeping,
    t,
    with_steps,
    x,
)

from nsmodel.hypotheses.certificates import verify


def test_no_forgery_of_the_list_is_answered_yes():
    answers = {name: verify.answer(*pair) for name, pair in FORGERIES.items()}
    assert {name: answer for name, answer in answers.items() if answer[0] not in ("no", "not checkable")} == {}
    assert not any("not well formed" in text for _, text in answers.values())


def test_the_true_ones_beside_them_are_proved():
    answers = {name: verify.answer(*pair) for name, pair in TRUE.items()}
    assert {name: answer for name, answer in answers.items() if answer[0] != "yes"} == {}


def test_the_sentence_is_made_from_the_numbers():
    model, statement = TRUE["M-A2"]
    lied = {**statement, "statement": "F is bounded", "why": "yes", "source": "A5 yes"}
    assert verify.answer(model, lied) == ("yes", "|v| <= 1 + 1 |x| for all x and all v in F(x) - S(x) - dphi(x)")
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
        for k, path in enumerate(list(places(list(pair)))[1:]):
            for junk in [JUNK[(k + i) % len(JUNK)] for i in range(4)]:
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
        assert "is not a certificate" in verify.main(str(path))


def test_functions_of_more_inputs_than_have_numbers_are_not_read():
    """Input 100000 would be taken for what a parameter moves with, a number between 0 and 1."""
    names = [f"x_{k}" for k in range(verify.FIRST_UNIT + 1)]
    assert verify.span(verify.variable(verify.FIRST_UNIT)).lo == 0
    model = {**oscillator(), "g": {"inputs": names, "steps": [["in", verify.FIRST_UNIT]], "outputs": [0]}}
    answer = verify.answer(model, claim("O-g", {"interior": ["0"]}, **{"lower bound of g": "0"}))
    assert answer == ("not checkable", "a function has too many inputs")


def test_programs_that_take_for_ever_are_not_read():
    squared = [["in", 0], *(["mul", k, k] for k in range(60))]
    model = {**inclusion(), "F": {"inputs": ["x"], "steps": [*squared, ["add", 1, 60]], "outputs": [61]}}
    assert verify.answer(model, claim("M-A2", a_1="1", a_2="1"))[0] != "yes"
    long = [["in", 0], ["const", "3"], *(["mul", k, k] for k in range(1, 60))]
    model = {**inclusion(), "F": {"inputs": ["x"], "steps": long, "outputs": [60]}}
    assert verify.answer(model, claim("M-A2", a_1="1", a_2="1"))[0] != "yes"
    model = with_steps(inclusion(), "F", ("in", 0), ("pow", 0, "1000000000000"))
    assert verify.answer(model, claim("M-A1", {"cover": None}, {"x": ["2", "3"]}))[0] != "yes"


# -- how numbers, graphs, boxes and files are written --------------------------------------------------------------------------

NO_NUMBERS = ("1.0", "1e0", "+1", " 1", "1 ", "1\n", "\u0661", "\uff11", "1_0", "0x1", "1/0", "1/00", "\u22121", "1/-2", "1/2/3",
              "1/", "/2", "--1", "\u00bd", "Infinity", "INF", "inf ", "nan", "", "9" * 4001, "1/" + "9" * 4001, 1, 1.0, 1e308,
              True, None, ["1"], {"1": "1"}, 10**400)  # fmt: skip
HUGE, TINY = "1" + "0" * 400, "1/1" + "0" * 400


def test_what_is_no_fraction_in_ascii_is_no_number():
    for junk in NO_NUMBERS:
        (model, s), (power, local) = TRUE["M-A2"], TRUE["M-A1"]
        pairs = [(model, {**s, "value": {**s["value"], "a_1": junk}}), (with_steps(model, "F", ("const", junk)), s),
                 (with_steps(power, "F", ("in", 0), ("pow", 0, junk)), local),
                 (power, {**local, "scope": {"states": {"x": [junk, "2"]}, "time": None}}),
                 ({**TRUE["4.1"][0], "D": [[junk]]}, TRUE["4.1"][1])]  # fmt: skip
        assert {verify.answer(*pair)[0] for pair in pairs} == {"no"}, junk


def graph(*steps, outputs=None, inputs=("x",)):
    """A function with these steps."""
    return {"inputs": list(inputs), "steps": [list(step) for step in steps], "outputs": outputs or [len(steps) - 1]}


M_A1 = claim("M-A1", {"cover": None}, {"x": ["1", "2"]})
M_A2 = claim("M-A2", a_1="0", a_2="1")
GRAPHS = {
    "a cycle of one": graph(("in", 0), ("add", 1, 1)), "a cycle of two": graph(("add", 1, 1), ("add", 0, 0)),
    "forward": graph(("in", 0), ("mul", 0, 2), ("const", "0")), "from the end": graph(("in", 0), ("mul", -1, 0)),
    "true": graph(("in", 0), ("in", False)), "an index in text": graph(("in", 0), ("exp", "0")),
    "a value from the end": graph(("in", 0), outputs=[-1]), "a value that is true": graph(("in", 0), ("in", 0), outputs=[True]),
    "a value of 1.0": graph(("in", 0), ("in", 0), outputs=[1.0]), "no value": {**graph(("in", 0)), "outputs": []},
    "two values": graph(("in", 0), outputs=[0, 0]), "no steps": graph(outputs=[0]), "an empty step": graph(("in", 0), ()),
    "a list for a name": graph(("in", 0), (["exp"], 0)), "another name": graph(("in", 0), ("__class__", 0)),
    "too much": graph(("in", 0), ("exp", 0, 0)), "too little": graph(("in", 0), ("mul", 0)),
    "an input twice": graph(("in", 0), inputs=("x", "x")), "another input": graph(("in", 0), inputs=("y",)),
    "no inputs": graph(("const", "0"), inputs=()),
    "an input of no name": graph(("in", 0), inputs=("",)), "an input that is no text": graph(("in", 0), inputs=(None,)),
    "an exponent in text": graph(("in", 0), ("pow", 0, "two")), "of another program": {"graph": graph(("in", 0))},
}  # fmt: skip


def test_a_graph_has_steps_of_earlier_ones_alone():
    for name, F in GRAPHS.items():
        of_S = name in ("another input", "no inputs")  # At which M-A1 does not look.
        for s in (M_A2,) if of_S else (M_A1, M_A2):
            model = {**inclusion(S=x * 1), "S": F} if of_S else {**inclusion(), "F": F}
            assert verify.answer(model, s)[0] == "no", name


def constrained(program, **more):
    """A sweeping process of one state with this constraint."""
    return {**sweeping(q), "constraints": [{"name": "g", "graph": program, **more}]}


def bowl(factor):
    """The constraint factor q^2."""
    return graph(("in", 1), ("mul", 0, 0), ("const", factor), ("mul", 1, 2), inputs=("t", "q"))


BALL = {"kind": "ball", "size": 1, "radius": "1"}
ADVERSARIES = {
    # Numbers that are 0 but for a hair, or beyond doubles.
    "alpha = -0": (inclusion(), claim("M-A3", {"monomials": [], "G": []}, alpha="-0", beta="1")),
    "h = -0/1": (TRUE["F-unique"][0], claim("F-step", {"inverse": [["1"]], "cover": None}, h="-0/1")),
    "a curvature of 1e-400": (
        constrained(bowl(TINY), delta="1"), claim("A4", forms(HALF_LINE), {"q": ["-1", "1"]}, M="0", M_contact="0")),
    "a bend down of 1e-400": (constrained(bowl("-" + TINY)), claim("S-convex", forms(HALF_LINE), {"q": ["-1", "1"]})),
    "a slope of 1e-400": (
        with_steps(inclusion(), "F", ("in", 0), ("const", TINY), ("mul", 0, 1)), claim("M-A2", a_1="0", a_2="0")),
    "omega = -1e-400": (lure(A=0 * x), claim("5.2", {"P": [["1"]]}, omega="-" + TINY)),
    "1e400 less 1e400": (with_steps(inclusion(), "F", ("const", HUGE), ("const", "-" + HUGE), ("add", 0, 1)), claim(
        "M-24", {"cover": None}, {"x": ["0", "1"]}, L="-1")),
    "1/1e-400 on an interval": (with_steps(inclusion(), "F", ("in", 0), ("pow", 0, "-1")), claim(
        "M-A1", {"cover": None}, {"x": ["-" + TINY, TINY]})),
    "1/sqrt(1e-400 x), x >= 0": (with_steps(
        inclusion(), "F", ("in", 0), ("const", TINY), ("mul", 0, 1), ("pow", 2, "-1/2")), claim(
            "M-A1", {"cover": None}, {"x": ["0", "1"]})),
    "a root below 0 by an exponent 2/4": (with_steps(inclusion(), "F", ("in", 0), ("pow", 0, "2/4")), claim(
        "M-A1", {"cover": None}, {"x": ["-1", "1"]})),
    "a pole by an exponent -0/1 less 1": (with_steps(inclusion(), "F", ("in", 0), ("pow", 0, "-3/3")), M_A2),
    # The box, and the time.
    "a box that the proof is not for": (inclusion(F=x**2), claim("M-24", {"cover": None}, {"x": ["-2", "2"]}, L="2")),
    "a box of another name": (inclusion(F=x**2), claim("M-24", {"cover": None}, {"X": ["-1", "1"]}, L="2")),
    "a box of a name with a blank": (inclusion(F=x**2), claim("M-24", {"cover": None}, {"x ": ["-1", "1"]}, L="2")),
    "a box of three ends": (inclusion(F=x**2), claim("M-24", {"cover": None}, {"x": ["-1", "1", "1"]}, L="2")),
    "a box in the statement alone": (inclusion(F=x**2), {**claim("M-24", {"cover": None}, L="2"), "box": {"x": ["-1", "1"]}}),
    "a scope that is false": (inclusion(F=x**2), {**claim("M-24", {"cover": None}, L="2"), "scope": False}),
    "a scope in the proof": (inclusion(F=x**2), claim("M-24", {"cover": None, "scope": {"states": {"x": ["-1", "1"]}}}, L="2")),
    "all times": (sweeping(q, f=q * t), claim("S-f", {"cover": None}, {"q": ["-1", "1"]}, K_f="1", L_f="1")),
    "the time as a state": (sweeping(q, f=q * t), claim("S-f", {"cover": None}, {"q": ["-1", "1"], "t": ["0", "1"]}, ["0", "2"],
                                                        K_f="1", L_f="1")),
    "a time that runs back": (sweeping(q, f=q * t), claim("S-f", {"cover": None}, {"q": ["-1", "1"]}, ["1", "0"],
                                                          K_f="1", L_f="1")),
    "a box of infinite length": (inclusion(F=-x), claim("M-A1", {"cover": None}, {"x": ["inf", "inf"]})),
    "a cover that is cut by true": (inclusion(phi=-ca.fabs(x)), claim("M-T", {"cover": [True, None, None]}, {"x": ["-1", "1"]})),
    "a cut of another input": (inclusion(), claim("M-A1", {"cover": [1, None, None]}, {"x": ["-1", "1"]})),
    # Parts of models that do not fit together.
    "a law of half a size": ({**lure(), "law": [{"kind": "box", "size": 1, "lower": ["-1"], "upper": []}]}, claim("3.1")),
    "a law of two sizes": ({**lure(), "law": [{"kind": "box", "lower": ["-1", "-1"], "upper": ["1", "1"]}]}, claim("3.1")),
    "a ball for an interval": ({**lure(), "law": [{**BALL, "radius": "0"}]}, claim("3.1")),
    "a ball of radius < 0": ({**lure(), "law": [{**BALL, "radius": "-1"}]}, claim("5.4a")),
    "an ellipsoid": ({**lure(D="1"), "law": [{"kind": "ellipsoid", "size": 1, "Q": [["1"]]}]}, claim("5.4b")),
    "a cone that is called a box": ({**lure(), "law": [{"kind": ["box"], "size": 1}]}, claim("5.4a")),
    "a potential for a law": (
        lure() | {"law": [{"kind": "potential", "graph": graph(("in", 0), ("pow", 0, "2"), inputs=("y",))}]}, claim("5.4c")),
    "an offset that moves": ({**lure(), "e": graph(("in", 0), inputs=("t",))}, claim("7.1", {})),
    "two constraints of one graph": (
        constrained(graph(("in", 1), ("in", 1), outputs=[0, 1], inputs=("t", "q"))), claim("S-start")),
    "a constraint of another state": (constrained(graph(("in", 1), inputs=("t", "r"))), claim("S-start")),
    "a constraint without time": (constrained(graph(("in", 1), inputs=("q", "t"))), claim(
        "S-convex", forms({"time": None}))),
    "a start of two states": (sweeping(q, q0="0") | {"q0": ["0", "0"]}, claim("S-start")),
    "a delta of nothing": (sweeping(q**2 - 1, deltas=[None]), claim("A2", forms(HALF_LINE), speed="0")),
    "friction of two speeds": (oscillator() | {"theta": [graph(("in", 1), inputs=("s", "u"))]}, claim(
        "O-dry", **{"radius of A(0)": "1"})),
    "a damping that is false": (oscillator() | {"damping": False}, claim("O-theta", {"theta": [{"cover": None}]})),
    "no steps": (oscillator(steps=()), claim("O-steps")),
    "a step of 0": (oscillator(steps=("0", "1")), claim("O-steps")),
    "a number that is none of its own": (inclusion(F=x - 1), claim("M-A2", a_1="1", a_2="1", rho="-5")),
    "a proof that is true": (inclusion(F=x - 1), {**claim("M-A2", a_1="1", a_2="1"), "proof": True}),
}  # fmt: skip


def test_no_adversary_is_answered_yes():
    answers = {name: verify.answer(*pair) for name, pair in ADVERSARIES.items()}
    assert {name: answer for name, answer in answers.items() if answer[0] not in ("no", "not checkable")} == {}
    assert len(answers) > 40
    assert {answers[name][0] for name in ("a ball for an interval", "an ellipsoid", "a potential for a law")} == {"not checkable"}


def test_a_deep_or_wide_cover_takes_bounded_time(monkeypatch):
    deep = wide = None
    for k in range(30000):
        deep, wide = [0, deep, None], [0, wide, wide] if k < 12 else wide
    assert verify.answer(inclusion(), claim("M-A1", {"cover": deep}, {"x": ["1", "2"]}))[0] == "no"
    local = claim("M-A1", {"cover": wide}, {"x": ["1", "2"]})
    assert verify.answer(inclusion(), local)[0] == "yes"
    monkeypatch.setattr(verify, "MAX_WORK", 10000)
    for pair in ((inclusion(), local), ({**inclusion(), "F": graph(("in", 0), *([("add", 0, 0)] * 10000))}, M_A1)):
        assert verify.answer(*pair) == ("not checkable", "more work than this file does")
    powers = [("in", 0), ("const", "1"), ("add", 0, 1), *(("pow", k, "16") for k in range(2, 9))]
    assert verify.answer(with_steps(inclusion(), "F", *powers), M_A2) == ("not checkable", "more work than this file does")
    assert verify.answer(inclusion(), M_A1)[0] == "yes"  # Each statement has its own.
    for _ in range(20):  # And what others do with polynomials is not counted.
        assert len(verify.Poly({((0, k + 1),): verify.ONE for k in range(2000)})) == 2000


def test_numbers_that_become_tiny_take_no_memory():
    steps = [("in", 0), ("const", "1/1000"), *(("mul", k, k) for k in range(1, 60)), ("pow", 60, "-1")]
    assert verify.answer(with_steps(inclusion(), "F", *steps[:-1]), M_A1)[0] == "yes"
    assert verify.answer(with_steps(inclusion(), "F", *steps), M_A1)[0] == "no"  # It may be 0 as far as this file knows.
    powers = [("in", 0), *(("pow", k, "1000") for k in range(20))]
    assert verify.answer(with_steps(inclusion(), "F", *powers), claim("M-A1", {"cover": None}, {"x": ["1/3", "1/2"]}))[0] == "yes"


def test_files_that_are_written_otherwise(tmp_path):
    written(tmp_path)
    path = tmp_path / "certificate.json"
    text = path.read_text()
    assert verify.main(str(path)) == 0
    for old, new in (('"a_1": "1"', '"a_1": "1", "a_1": "0"'), ('"format": 4', '"format": 3'), ('"model": {', '"model": [{'),
                     ('{"format"', '\ufeff{"format"'), ('"statements": [', '"statements": [[')):  # fmt: skip
        assert old in text
        path.write_text(text.replace(old, new, 1), encoding="utf-8")
        assert "is not a certificate" in verify.main(str(path))
    for old, new in (('"a_1": "1"', '"a_1": 1'), ('"a_1": "1"', '"a_1": 1e400'), ('"a_1": "1"', '"a_1": NaN'),
                     ('"hash": "', '"hash": "0'), ('"scope": null', '"scope": -Infinity'), ('"title": "a title"', '"hash ": 1'),
                     ('"proof": {}', '"proof": []')):  # fmt: skip
        path.write_text(text.replace(old, new, 1))
        assert old in text
        assert verify.main(str(path)) == (0 if "title" in old else 1)


# -- a search at random, and the checker with a premise dropped --------------------------------------------------------------


def test_no_forgery_is_found_at_random():
    found, accepted = [], 0
    for rule in verify.STATEMENTS:
        assert forgeries.originals()[rule], rule
        search = forgeries.Search(rule, seed=5)
        found += search.go(12, seconds=0.3)
        accepted += search.yes
    assert not found, found[0]
    assert accepted > 50  # Many changes leave a statement true: the oracle has something to look at.


def test_a_statement_is_tried_once():
    search = forgeries.Search("O-steps")
    seen = [json.dumps([model["steps"], s], sort_keys=True) for model, s in search.forge(300)]
    assert len(seen) == 300 == len(search.statements)
    assert len(set(seen)) == 300


def test_the_oracle_finds_no_fault_with_what_is_true():
    for pairs in forgeries.originals().values():
        assert not falsity.find(*pairs[0], seed=1)
    assert not any(falsity.find(*pair) for pair in TRUE.values())


SEEN = "O-g; O-theta by rules; M-A3, squares; M-T of -|x|; O-dry, two opposed; 5.4c, D < 0; A5, d = 0; M-T, phi and S"
SEEN += "; M-24, C not convex; M-A2 of x/x - 1; 4.1, least < 0; 7.1 of 0/t; F-unique, K empty; A0, no c and no U"


def test_the_oracle_sees_that_forgeries_are_false():
    assert [name for name in SEEN.split("; ") if not any(falsity.find(*FORGERIES[name], seed=k) for k in range(4))] == []


def test_programs_in_doubles_and_with_50_digits_have_the_same_values():
    u, v = (ca.SX.sym(name) for name in "uv")
    text = ca.vertcat(
        ca.fmax(u * v, ca.exp(u) - v), ca.sqrt(1 + u**2) / (2 + ca.tanh(v)), ca.tanh(u) ** 3 * ca.sin(v), ca.sqrt(3 + u)
    )
    f = falsity.Function(program(text, ca.vertcat(u, v)))
    for point in ([0.5, -0.25], [-1.0, 2.0], [2.5, 0.0]):
        with mpmath.workdps(50):
            exact = f.values([mpmath.mpf(x) for x in point])
        for a, b in zip(f.values(point), exact, strict=True):
            assert [float(x) for x in (b.v, *b.g)] == pytest.approx([a.v, *a.g], rel=1e-13, abs=1e-15)
    with pytest.raises(falsity.Missing):
        f.values([-4.0, 0.0])


def test_the_search_finds_what_a_checker_without_a_premise_lets_pass():
    found, passed = forgeries.found_without(
        ["O-dry", "O-steps", "4.1"], 300, within=("OscillatorData.dry", "OscillatorData.steps_grow", "LureData.feedthrough")
    )
    assert not passed
    assert len(found) >= 6


def test_all_rules_have_premises_that_can_be_dropped():
    _, premises = forgeries.marked_checker()
    owners = {place.split()[0].split(".")[-1] for place in premises.places}
    assert {rule.__name__ for rule in verify.STATEMENTS.values()} - owners <= {"range_meets_domain"}  # Which asks two others.
    assert len(premises.places) > 120
