"""A small share of the search for refused steps and silent nonsense, and whether the search finds what is put there."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from fuzz_models import COUNT, FULL, share
from search import checked, consequences, oracle
from search.digits import Exact, column, floats
from search.judge import REFUSED, VIOLATED, WELL, WRONG_L, WRONG_X, Run, Verdict, judge, judge_run
from search.models import KINDS, Case, case
from search.truth import Teller

from nsmodel import LureSystem, SweepingProcess, check, complementarity
from nsmodel.solvers.one_step_problem import one_step_problem

SMALL = 5  # Models of each class.
MOST = 14  # States of the largest of them.
FIRST = 200  # Seed of the first of them.
FOUND = {  # Models that the search found steps refused in, by what made it.
    "oscillator:24": "a position far from 0, whose rounding is all that its row misses by",
    "oscillator:34": "the same, of masses in a chain",
    "first:1000": "a state of 1e-79",
    "lure:5": "a chain at rest: rows whose true value is 0",
    "lure:2": "a chain of which one block is pulled: the forces of the others are what rounding leaves of 0",
    "lure:6": "multipliers in units of 1e-8 to 1e8: rows that are small beside others were on the wrong side",
    "lure:58": "rows and multipliers in units of their own, of bodies of 1 to 1e12",
    "lure:320": "the same, of a dissipative system",
    "lure:422": "the same: a wrong state was certified",
    "sweeping:80": "planes that nearly oppose each other: W has lost what the whole system tells",
    "sweeping:268": "the same, and W takes another index set for the right one",
    "sweeping:260": "planes in units of 1e-5 whose forces cancel: compiled, the answer was as good as W tells",
    "sweeping:549": "rows in units of 1e-8 to 1e8: the solution by W was as good as rounding tells, not as good as it gets",
    "lure:468": "multipliers that cancel to a part of 1e-5: an error beside them was one of the motion",
    "lure:834": "rows that nearly repeat others, not monotone: from all rows held the active set method finds it, from none not",
    "lure:910": "a light mass held between heavy ones: compiled, the pseudo-inverse of W told its force to 2e-4",
    "lure:138": "rows that repeat others to 1e-9: the index set that W calls for holds one too many",
    "first:1444": "the same, of a first-order system with masses of 1 to 1e12",
    "oscillator:371": "a kink at 2.5e9: z was exact by its row, and the other rows solved for another z",
    "first:645": "copies of a bilinear model: Newton's method on the whole is not that on its parts",
    "first:832": "copies of states that decay",
    "first:788": "a bilinear force at a state that must be 0: its multiplier ran away and excused the force itself",
    "first:1589": "copies of a large scene: one block is at rest, and its rows are what rounding leaves of 0",
    "inclusion:1473": "curved rows in units of 1e-6 to 1e5: the forces of the last cuts were lost in their units",
    "inclusion:951": "53 curved rows: Newton's method did not settle",
    "inclusion:768": "copies of ellipsoids",
    "sweeping:113": "copies of planes that nearly oppose each other",
    "sweeping:303": "the same",
    "sweeping:576": "exponentials of q in units of 1e-6: the step was not seen to be a projection",
    "sweeping:615": "planes at 1e-7: a set of rows that W cannot tell from the right one",
    "sweeping:1076": "the same: x was off by a third of its motion, and certified",
    "sweeping:1905": "the same, alone and in copies: rows that cannot all be held, left open by 1e-10 of the motion",
    "sweeping:1420": "copies of such planes",
    "sweeping:457": "rows that repeat one another: one of many index sets, off by 1e-9 of what moves, was taken unrefined",
    "sweeping:370": "curved rows at 1e6: Jacobians of collected terms lost six digits",
}
# Their 50 digits take ten seconds and more: not where a part of the random models is asked for.
LONG = {"first:1589", "inclusion:1473", "inclusion:951", "inclusion:768", "sweeping:113"} if COUNT < FULL else set()
# Here the last digits decide which of neighbouring index sets is taken, and they differ from processor to processor.
BY_ROUNDING = pytest.mark.xfail(reason="right on some processors, on others off by more than is promised", strict=False)
BEYOND = {"sweeping:13": "a point between two discs", "sweeping:206": "a point between discs that close"}


@pytest.mark.parametrize("name", KINDS)
def test_no_step_with_a_solution_is_refused_and_none_is_wrong(name):
    for seed in small(name):
        verdict = judge(case(name, seed), checks=3)
        assert not [f for f in verdict.findings if not f.condition > WELL], f"python -m tests.search --one {name}:{seed}"


@pytest.mark.parametrize(
    "one", [pytest.param(one, marks=[BY_ROUNDING] * (one == "sweeping:1905")) for one in FOUND if one not in LONG]
)
def test_a_step_once_refused_is_taken(one):
    name, seed = one.split(":")
    verdict = judge(case(name, int(seed)), checks=2)
    assert not [f for f in verdict.findings if not f.condition > WELL], FOUND[one]
    assert verdict.steps > 0


@pytest.mark.parametrize(
    "one",
    ["sweeping:80", "sweeping:370", "lure:910"]
    + [pytest.param(one, marks=BY_ROUNDING) for one in ("sweeping:260", "sweeping:1905")],
)
def test_a_step_in_c_that_was_wrong_is_right(one):
    name, seed = one.split(":")
    verdict = judge(case(name, int(seed)), compiled=True, checks=2)
    assert not verdict.findings, FOUND[one]
    assert verdict.steps > 0


@pytest.mark.parametrize("one", BEYOND)
def test_a_point_that_was_thrown_away_is_kept(one):
    """Its step is refused by name, and the solution of its linearisation is far beyond where that means anything."""
    name, seed = one.split(":")
    verdict = judge(case(name, int(seed)), checks=1)
    assert not verdict.findings, BEYOND[one]
    assert len(verdict.beyond) == 1


def small(name):
    """Seeds of models with few states."""
    seeds = (seed for seed in range(FIRST, FIRST + 1000) if len(case(name, seed).model().names) <= MOST)
    return [next(seeds) for _ in range(SMALL)]


CONTACT = {
    "A": [[0.0, 0.0], [0.0, -1.0]], "B": [[1.0], [1.0]], "C": [[1.0, 1.0]], "f": [-1.0, 0.0], "law": complementarity(1),
    "x0": [0.0, 0.0], "step": 0.5, "t_end": 2.0,
}  # fmt: skip


def test_the_truth_is_that_of_a_step_solved_by_hand():
    problem = one_step_problem(LureSystem(**CONTACT))
    truth = Teller(problem).tell(0.0, 0.5, np.zeros(2), np.zeros(2), np.ones(1), np.array([-1]))  # wrong set: it must be left
    # x1 = -h + h l, x2 = h l / (1 + h), x1 + x2 = 0: l = 1 / (1 + 1/(1 + h)) = 0.6
    assert [float(v) for v in (*truth.z, *truth.l)] == pytest.approx([-0.2, 0.2, 0.6], rel=1e-15)
    assert abs(truth.l[0] * 10 - 6) < 1e-55
    assert truth.index.tolist() == [0]
    assert 1 <= truth.condition < 10


@pytest.mark.parametrize(("column_of", "what"), [("x", WRONG_X), ("l", WRONG_L)])
def test_an_error_of_1e_6_is_found(column_of, what):
    one = Case("lure", 0, "LureSystem", "contact", CONTACT)
    run, verdict = Run(one.model(), False), Verdict(one)
    judge_run(one, one.model(), run, 10, verdict)
    assert not verdict.findings
    getattr(run, column_of)[2] *= 1 + 1e-6
    judge_run(one, one.model(), run, 10, verdict)
    assert what in {f.what for f in verdict.findings}


def test_a_refusal_of_what_has_a_solution_is_found():
    one = Case("lure", 0, "LureSystem", "contact", CONTACT)
    run, verdict = Run(one.model(), False), Verdict(one)
    run.error, run.N = ArithmeticError("refused"), 2
    judge_run(one, one.model(), run, 10, verdict)
    assert [f.what for f in verdict.findings] == [REFUSED]
    assert verdict.findings[0].condition < 10


def test_a_point_inside_the_obstacle_is_found():
    q = ca.SX.sym("q", 2)
    arguments = {"q": q, "f": [1, 0], "constraints": {"disc": ca.norm_2(q) - 1}, "q0": [-1, 0.1], "step": 0.1, "t_end": 0.5}
    one = Case("sweeping", 0, "SweepingProcess", "disc", arguments)
    assert isinstance(one.model(), SweepingProcess)
    run, verdict = Run(one.model(), False), Verdict(one)
    judge_run(one, one.model(), run, 10, verdict)
    assert not verdict.findings
    run.x[3] *= (1 - 1e-12) / np.linalg.norm(run.x[3])
    judge_run(one, one.model(), run, 0, verdict)
    assert {f.what for f in verdict.findings} == {VIOLATED}


def test_expressions_have_as_many_digits_as_promised():
    x = ca.SX.sym("x", 2)
    tell = Exact(
        [x], [ca.vertcat((1 + x[0]) - 1, ca.sin(x[1]) ** 2 + ca.cos(x[1]) ** 2 - 1, ca.fmax(x[0], x[1]), ca.log(ca.exp(x[1])))]
    )
    (small_again, unity, larger, same) = tell(column([2.0**-180, 0.7]))[0]
    assert abs(small_again / column([2.0**-180])[0] - 1) < 1e-9
    assert abs(unity) < 1e-60
    assert floats([larger, same]).tolist() == [0.7, 0.7]


FROZEN = {  # Texts of the first 12 models of each class: rates of other days are compared with these models.
    "sweeping": "347dea49a4d80121",
    "oscillator": "1a617ed8b30be6a7",
    "first_order": "6e7245e9f1ec5f81",
    "lure": "9dc96b719257361f",
    "inclusion": "2c6f143d7a0b520d",
    "bodies": "7daf95d604f4dcd7",
}


def test_the_models_of_the_checker_are_those_of_other_days():
    assert {name: checked.fingerprint(name, range(12)) for name in checked.MAKERS} == FROZEN


@pytest.mark.long
@pytest.mark.parametrize("name", oracle.ORACLES)
def test_the_checker_says_nothing_false_of_the_first_models(name):
    for seed in range(share(2)):
        row = oracle.judged(name, seed)
        assert row["held"]
        assert not row["contradictions"]
        assert not {"crash", "fault"} & set(row)


@pytest.mark.parametrize(
    ("name", "seed", "id", "number", "wrong"),
    [("inclusion", 1, "M-A2", "a_2", 0.5), ("sweeping", 3, "A4", "M", 3.9), ("lure", 0, "5.2", "omega", 0.2),
     ("oscillator", 0, "O-dry", "radius of A(0)", 2.1), ("inclusion", 5, "M-24", "L", 0.3)],
)  # fmt: skip
def test_a_false_number_is_found(name, seed, id, number, wrong):
    report = check(checked.draw(name, seed), runs=[])
    false = tuple(replace(f, value={**f.value, number: wrong}) if f.id == id else f for f in report.findings)
    trial = oracle.Trial(name, seed, replace(report, findings=false), np.random.default_rng(0))
    with np.errstate(all="ignore"):
        oracle.ORACLES[name](trial)
    assert {item["id"] for item in trial.bad} >= {id}


def _tried(name, report, item):
    trial = oracle.Trial(name, 0, replace(report, consequences=(item,)), np.random.default_rng(0))
    with np.errstate(all="ignore"):
        consequences.try_consequences(trial)
    return {found["id"] for found in trial.bad}


@pytest.mark.parametrize(
    ("name", "seed", "id", "false"),
    [("sweeping", 1, "prox-regular", {"eta": 10}), ("sweeping", 10, "K_L", {"K_L": 0.3}),
     ("sweeping", 12, "linearisation error", {"M/(2a)": 0.3}), ("sweeping", 9, "metric qualification", {"Theta": 0.2}),
     ("lure", 5, "contraction", {"omega": 2}), ("inclusion", 1, "bounded", {"radius": 0.3, "absorbing radius": 0.3}),
     ("inclusion", 7, "contraction", {"L": 9}), ("first_order", 2, "order", {"order": 3})],
)  # fmt: skip
def test_a_false_consequence_is_found(name, seed, id, false):
    report = check(checked.draw(name, seed), runs=[])
    item = next(item for item in report.consequences if item.name == id)
    assert item.verdict == "holds"
    assert not _tried(name, report, item)
    wrong = {key: number * false.get(key, 1) for key, number in item.value.items()}
    assert id in _tried(name, report, replace(item, value=wrong))


def test_a_step_that_cannot_be_taken_contradicts_a_bound_of_steps():
    t, q = ca.SX.sym("t"), ca.SX.sym("q")
    walls = SweepingProcess(t=t, q=q, f=0, q0=[0.5], constraints={"low": q - t / 4, "high": 1 - t / 4 - q}, t_end=1, step=0.01)
    report = check(walls, runs=[])
    item = next(item for item in report.consequences if item.name == "step bound")
    false = replace(item, verdict="holds", scope=None, value={"h": 1e6})
    assert _tried("sweeping", report, false) == {"step bound"}
