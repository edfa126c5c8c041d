"""Certificates for all parameters of a box, and for all members of a family: true ones are proved, others are not."""

from __future__ import annotations

import copy
import json
import math
import subprocess
import sys
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
from search import falsity
from search.claims import OF_PARAMETERS, claim, over, s, t, x, y, z

from nsmodel import (
    Bodies,
    Family,
    FirstOrderSystem,
    FrictionOscillator,
    Items,
    LureSystem,
    ManyBodies,
    MonotoneInclusion,
    SweepingProcess,
    UsageError,
    check,
    complementarity,
    relay,
)
from nsmodel.cli import main
from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.write import certificate_of

p, r = ca.SX.sym("p"), ca.SX.sym("r")


# -- statements of one number p, true up to an end of its interval -----------------------------------------------------------


@pytest.mark.parametrize("name", OF_PARAMETERS)
def test_up_to_the_end_of_the_interval_and_no_further(name):
    model, statement, ends, wider = OF_PARAMETERS[name]
    answer, sentence = verify.answer(model, over(statement, *ends))
    assert (answer, "; for every p in [" in sentence) == ("yes", True), sentence
    assert wider is None or verify.answer(model, over(statement, *wider))[0] != "yes"


@pytest.mark.parametrize("name", OF_PARAMETERS)
def test_no_parameter_is_left_out_and_no_interval_is_empty(name):
    model, statement, (low, high), _ = OF_PARAMETERS[name]
    none_given = [statement, {**statement, "scope": {"parameters": {}}}, {**statement, "scope": {"parameters": None}}]
    wrong = [(high, f"{low}/1") if "/" not in low else (high, "-999"), ("nan", high), (low, "inf"), ("-inf", high), (low,), ()]
    own = next(part["inputs"][0] for part in model.values() if isinstance(part, dict) and "inputs" in part)
    others = [over(statement, *ends) for ends in wrong] + [
        over(statement, low, high, name=own),
        over(statement, low, high, name="r"),
    ]
    both = {**statement, "scope": {"parameters": {"p": [low, high], "r": ["0", "1"]}}}
    boxed = {**over(statement, low, high), "scope": {"states": {"p": ["0", "1"]}, "parameters": {"p": [low, high]}}}
    unknown = {**over(statement, low, high), "scope": {"states": {"w": ["0", "1"]}, "parameters": {"p": [low, high]}}}
    for forged in [*none_given, *others, both, boxed, unknown]:
        assert verify.answer(model, forged)[0] == "no", forged["scope"]
    for names in ([], ["r"], ["p", "p"], None):
        assert verify.answer({**model, "parameters": names}, over(statement, low, high))[0] == "no"
    hidden = {**model, "parameters": []}  # Then p is a state, of which A5 of one constraint asks nothing.
    assert verify.answer(hidden, statement)[0] != "yes" or name == "A5"


# -- reports over boxes ------------------------------------------------------------------------------------------------------


def moving_models():
    """Models of each class with parameters in what hypotheses read, and their boxes."""
    step = {"t_end": 1.0, "step": 0.1}
    box = {"p": (0.5, 2.0), "r": (0.25, 1.0)}
    given = {"parameters": {p: 1.0, r: 0.5}, **step}
    yield LureSystem(A=[[-r / p, -1 / p], [1 / r, 0]], B=[1 / p, 0], C=[1, 0], law=relay(1), x0=[1, 0], **given), box
    yield LureSystem(A=[[-p]], B=[p], C=[r], D=[[r]], law=complementarity(1), x0=[p], **given), box
    disc = ca.norm_2(z - ca.vertcat(t, 0)) - r
    yield SweepingProcess(t=t, q=z, f=[p, -r], constraints={"disc": disc}, q0=[2, 0], **given), box
    yield FirstOrderSystem(x=x, lam=y, f=[-p * x], g=[r * y], h=[r * x + y], law=complementarity(1), x0=[p], **given), box
    yield FrictionOscillator(x=x, s=s, friction=r * s + s**2, potential=p * x**2, x0=p, v0=0, **given), box
    yield MonotoneInclusion(x=z, field=[z[1] - p * z[0], -z[0] - r * z[1] + p], operator=r * ca.sign(z), x0=[0, 0], **given), box


@pytest.mark.parametrize("k", range(6))
def test_what_holds_over_a_box_is_proved_and_true_at_its_points(k):
    model, box = list(moving_models())[k]
    certificate = json.loads(json.dumps(certificate_of(check(model, parameters=box, quick=True))))
    answers = {one["id"]: verify.answer(certificate["model"], one) for one in certificate["statements"]}
    assert sum(answer == "yes" for answer, _ in answers.values()) >= 3
    assert not any(answer == "no" for answer, _ in answers.values()), answers
    rng = np.random.default_rng(k)
    for one in certificate["statements"]:
        if answers[one["id"]][0] != "yes":
            continue
        assert "; for every p in [1/2, 2]; for every r in [1/4, 1]" in answers[one["id"]][1]
        bare = {**one, "scope": {name: part for name, part in one["scope"].items() if name != "parameters"} or None}
        for _ in range(2):
            values = {name: Fraction(int(rng.integers(1, 1024)), 1024) for name in box}
            values = {name: Fraction(low) + values[name] * Fraction(high - low) for name, (low, high) in box.items()}
            assert not falsity.find(falsity.at(certificate["model"], values), falsity.at(bare, values), seed=k), one["id"]


def test_a_parameter_as_b(tmp_path):
    """B = p: all parts of the proof are for all p of the box, and none without it."""
    model = LureSystem(A=[[-1]], B=[p], C=[1], law=relay(1), x0=[1], t_end=1, step=0.1, parameters={p: None})
    with pytest.raises(UsageError, match="give a value or a box to p"):
        certificate_of(check(model))
    certificate = certificate_of(check(model, parameters={"p": (0.5, 2)}, quick=True))
    assert certificate["model"]["B"][0][0]["inputs"] == ["p"]
    assert {verify.answer(certificate["model"], one)[0] for one in certificate["statements"]} == {"yes"}
    for one in certificate["statements"]:
        without = {**one, "scope": None}
        assert verify.answer(certificate["model"], without)[0] == "no"
        assert verify.answer(certificate["model"], over(one, "-1", "2"))[0] == ("no" if one["id"] in ("5.1", "5.2") else "yes")


def test_the_command_line_writes_it(tmp_path, capsys):
    path = tmp_path / "one.py"
    path.write_text("import casadi as ca\nfrom nsmodel import LureSystem, relay\np = ca.SX.sym('p')\nmodel = LureSystem("
                    "A=[[-p]], B=[p], C=[1], law=relay(1), x0=[1], t_end=1, step=0.1, parameters={p: 1.0})\n")  # fmt: skip
    assert main(["check", str(path), "--quick", "--parameters", "p=0.5:2", "--certificate", str(tmp_path / "c")]) == 0
    assert "statements" in capsys.readouterr().out
    found = subprocess.run(
        [sys.executable, "-I", "-S", "verify.py", "certificate.json"], cwd=tmp_path / "c", capture_output=True, text=True
    )
    assert found.returncode == 0
    assert "P B = C'; for every p in [1/2, 2]\n" in found.stdout
    assert ", 0 no, 0 not checkable" in found.stdout


def test_time_is_a_parameter_of_an_inclusion():
    model = MonotoneInclusion(t=t, x=x, field=[-x + ca.sin(3 * t)], operator=ca.sign(x), lower=[-2], x0=[0], t_end=1, step=0.1)
    certificate = certificate_of(check(model, quick=True))
    answers = {one["id"]: verify.answer(certificate["model"], one) for one in certificate["statements"]}
    assert all(answers[id][0] == "yes" for id in ("M-T", "M-C", "M-A1", "M-A2", "M-A3", "M-24")), answers
    assert answers["M-A2"][1].endswith("for every t in [0, 1]")
    one = next(one for one in certificate["statements"] if one["id"] == "M-A2")
    assert verify.answer(certificate["model"], {**one, "value": {**one["value"], "a_1": "19/10"}})[0] == "no"


# -- families ----------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def crowd():
    rng = np.random.default_rng(1)
    rows = np.stack(np.meshgrid(range(7), range(5)), axis=-1).reshape(-1, 2) + rng.uniform(-0.1, 0.1, (35, 2))
    people, walls = Bodies(rows, r=rng.uniform(0.2, 0.35, 35)), Items(a=[(-1.0, -1.1)], b=[(8.0, -0.7)])
    i, j, w = people.member("i"), people.member("j"), walls.member("w")
    along = w.b - w.a
    part = ca.fmin(ca.fmax(ca.dot(i.q - w.a, along) / ca.sumsqr(along), 0), 1)
    families = {
        "pair": Family(ca.norm_2(i.q - j.q) - i.r - j.r, i, j),
        "wall": Family(ca.norm_2(i.q - w.a - part * along) - i.r, i, w),
    }
    model = ManyBodies(bodies=people, f=ca.vertcat(1, 0), constraints=families, t_end=1, step=0.1)
    return json.loads(json.dumps(certificate_of(check(model, [], quick=True))))


def test_families_are_proved_once_for_all_members(crowd):
    answers = {one["id"]: verify.answer(crowd["model"], one) for one in crowd["statements"]}
    proved = {id for id, (answer, _) in answers.items() if answer == "yes"}
    assert proved >= {"S-convex", "A0", "A1", "A2", "A3", "A4", "S-start"}
    assert not any(answer == "no" for answer, _ in answers.values())
    assert "for each of 630 i" in answers["S-convex"][1]  # 35 * 34 / 2 pairs, and a wall.
    assert len(crowd["model"]["constraints"]) == 2


def test_no_member_is_left_out_of_what_is_said(crowd):
    by_id = {one["id"]: one for one in crowd["statements"]}

    def answer(id, change, model=crowd["model"], **value):
        model = copy.deepcopy(model)
        change(model["constraints"])
        return verify.answer(model, {**by_id[id], "value": {**by_id[id]["value"], **value}})[0]

    def put(row, member, part, value):
        return lambda rows: rows[row]["members"][member].update({part: value})

    assert answer("S-start", put(0, 17, "numbers", ["9", "9"])) == "no"
    assert answer("A4", put(0, 17, "numbers", ["1/1000", "1/1000"])) == "no"
    assert answer("A0", put(1, 3, "numbers", ["1/1000"])) == "no"
    for value in (["q_0", "q_1", "q_2"], ["q_0", "q_0", "q_2", "q_3"], ["q_0", "q_1", "q_2", "nobody"], []):
        assert answer("S-convex", put(0, 17, "states", value)) == "no"
    assert answer("S-convex", lambda rows: rows[0].update(members=[])) == "no"
    assert answer("S-convex", lambda rows: rows[0].update(numbers=["i.r", "i.r"])) == "no"
    renamed = crowd["model"]["constraints"][0]["graph"]["inputs"]
    renamed = ["q_0" if name == "i.q_0" else name for name in renamed]
    assert answer("S-convex", lambda rows: rows[0]["graph"].update(inputs=renamed)) == "no"
    assert answer("A4", lambda rows: None, M="1") == "no"
    one = {**by_id["S-convex"], "scope": {"states": {"i.q_0": ["0", "1"]}}}
    assert verify.answer(crowd["model"], one)[0] == "no"
    hints = {"cover": ["1", "0"]}
    forged = claim("A5", hints, gamma="1", rho="1")
    assert verify.answer(crowd["model"], forged)[0] != "yes"


# -- distances to half lines, strips, boxes, segments ------------------------------------------------------------------------


CLIPS = {
    "half line up": lambda u: ca.fmax(u, -1),
    "half line down": lambda u: ca.fmin(u, 2),
    "interval": lambda u: ca.fmin(ca.fmax(u, -8), 8),
    "interval, the other way": lambda u: ca.fmax(ca.fmin(u, 8), -8),
}


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("clip", CLIPS)
def test_distances_with_one_coordinate_clipped(clip, n):
    v = ca.SX.sym("v", n)
    nearest = ca.vertcat(CLIPS[clip](v[0]), *([0.0] * (n - 1)))
    start = ca.vertcat(*([30.0 if clip != "half line up" else -30.0] + [0.0] * (n - 1)))
    model = SweepingProcess(q=v, f=ca.DM.zeros(n), constraints={"d": ca.norm_2(v - nearest) - 0.5}, q0=start, t_end=1, step=0.1)
    certificate = certificate_of(check(model, [], quick=True))
    by_id = {one["id"]: one for one in certificate["statements"]}
    asked = [id for id in ("S-convex", "A0", "A1", "A2", "A3", "A4", "S-start") if id in by_id]
    assert len(asked) >= 6
    assert {id: verify.answer(certificate["model"], by_id[id])[0] for id in asked} == dict.fromkeys(asked, "yes")
    for id, value in (
        ("A1", {"a": "1001/1000"}),
        ("A1", {"b": "999/1000"}),
        ("A4", {"M": "39/10"}),
        ("A4", {"M_contact": "19/10"}),
    ):
        assert verify.answer(certificate["model"], {**by_id[id], "value": {**by_id[id]["value"], **value}})[0] == "no"


# -- parts, against what was not computed with the same code -----------------------------------------------------------------


def test_polynomials_of_parameters_lie_between_their_corners():
    rng = np.random.default_rng(2)
    for _ in range(40):
        units = [verify.variable(verify.FIRST_UNIT + k) for k in range(2)]
        powers = [(int(a), int(b)) for a, b in rng.integers(0, 4, (4, 2))]
        sizes = [Fraction(int(a), 4) for a in rng.integers(-8, 9, 4)]
        terms = [math.prod([units[0]] * a + [units[1]] * b, start=verify.constant(1)) for a, b in powers]
        poly = sum((c * term for c, term in zip(sizes, terms, strict=True)), verify.constant(0))
        low, high = verify.least(poly), -verify.least(-poly)
        at = [[Fraction(int(a), 8) for a in pair] for pair in rng.integers(0, 9, (12, 2))]
        values = [sum(c * u**a * w**b for c, (a, b) in zip(sizes, powers, strict=True)) for u, w in at]
        assert low <= min(values)
        assert max(values) <= high
        corners = [sum(c * u**a * w**b for c, (a, b) in zip(sizes, powers, strict=True)) for u in (0, 1) for w in (0, 1)]
        assert low <= min(corners) <= max(corners) <= high
        if all(a <= 1 and b <= 1 for a, b in powers):
            assert (low, high) == (min(corners), max(corners))


def test_matrices_of_parameters_are_definite_where_all_are():
    """[[1, u], [u, c]] with u in [0, 1] is psd for c >= 1 alone; [[u, u - 1], [u - 1, 1 - u]] is not."""
    u = verify.variable(verify.FIRST_UNIT)
    assert verify.psd([[Fraction(1), u], [u, Fraction(1)]])
    assert not verify.psd([[Fraction(1), u], [u, Fraction(1)]], definite=True)
    assert not verify.psd([[Fraction(1), u], [u, Fraction(999, 1000)]])
    assert not verify.psd([[u, u + -1], [u + -1, -u + 1]])


def test_functions_of_parameters_are_units_between_their_values():
    """1/p and exp(p) for p in [1, 2]: units of their own, the same in each place; 1/p of [-1, 1] has none."""
    one = {"p": verify.between(0, Fraction(1), Fraction(2))}
    inverse = verify.number({"inputs": ["p"], "steps": [["in", 0], ["pow", 0, "-1"]], "outputs": [1]}, parameters=one)
    assert (verify.least(inverse), -verify.least(-inverse)) == (Fraction(1, 2), 1)
    again = verify.number({"inputs": ["p"], "steps": [["in", 0], ["pow", 0, "-1"]], "outputs": [1]}, parameters=one)
    assert again == inverse
    power = verify.number({"inputs": ["p"], "steps": [["in", 0], ["exp", 0]], "outputs": [1]}, parameters=one)
    assert (round(float(verify.least(power)), 12), round(float(-verify.least(-power)), 12)) == (2.718281828459, 7.389056098931)
    assert len(verify.corners([inverse, power])) == 4
    for step, ends in ((["pow", 0, "-1"], (-1, 1)), (["pow", 0, "-1/2"], (0, 1)), (["pow", 0, "1/2"], (-1, 1))):
        wide = {"p": verify.between(0, *map(Fraction, ends))}
        with pytest.raises(verify.Unproved):
            verify.number({"inputs": ["p"], "steps": [["in", 0], step], "outputs": [1]}, parameters=wide)
