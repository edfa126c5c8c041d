"""Hypotheses that fail at one value of a parameter, or at one time, that no double is; roots in 40 digits."""

import casadi as ca
import mpmath
import pytest

from nsmodel import LureSystem, MonotoneInclusion, SweepingProcess, check, relay
from nsmodel.hypotheses.exact_roots import models_at_roots

P, T, X = ca.SX.sym("p"), ca.SX.sym("t"), ca.SX.sym("x")
TIMES = {"t_end": 1.0, "step": 0.1}
UNITS = [  # u(s) with one root in (0.1, 0.9), and the root
    (lambda s: s**2 - 0.3, mpmath.sqrt(0.3)), (lambda s: s**3 - 0.25, mpmath.cbrt(0.25)),
    (lambda s: ca.sin(4 * s), mpmath.pi / 4),
    (lambda s: ca.exp(s) - 2, mpmath.log(2)), (lambda s: ca.cos(s) - s, mpmath.findroot(lambda z: mpmath.cos(z) - z, 0.7)),
    (lambda s: s - 0.3, mpmath.mpf(0.3)), (lambda s: 3 * s - 1, mpmath.mpf(1) / 3),
    (lambda s: s**2 + s - 1, (mpmath.sqrt(5) - 1) / 2),
    (lambda s: s**5 - s + 0.25, None), (lambda s: ca.log(s) + 0.5, mpmath.exp(-0.5)),
    (lambda s: ca.atan(s) - 0.5, mpmath.tan(0.5)),
]  # fmt: skip


def lure(C):
    return LureSystem(A=[[-1]], B=[1], C=[C], law=relay(1), x0=[1], parameters={P: 0.2}, **TIMES)


@pytest.mark.parametrize("k", range(len(UNITS)))
def test_models_at_roots_have_the_numbers_of_the_root(k):
    u, root = UNITS[k]
    found = list(models_at_roots(lure(3 * u(P) ** 2 + 0.5), {"p": (0.1, 0.95)}))
    assert found
    near = [values["p"] for values, _, there in found if float(ca.DM(there.C)) == 0.5]
    assert len(near) == 1 + (k == 8)
    assert root is None or abs(near[0] - float(root)) < 1e-15
    for values, _, there in found:  # other places: least values of parts
        at = float(ca.Function("C", [P], [3 * u(P) ** 2 + 0.5])(values["p"]))
        assert abs(float(ca.DM(there.C)) - at) < 1e-12


def test_what_reads_the_parameter_in_another_way_is_no_exact_model():
    assert not list(models_at_roots(lure((P**2 - 0.3) ** 2 * ca.exp(P) + P), {"p": (0.1, 0.9)}))
    assert not list(models_at_roots(lure((P**2 + 0.3) ** 2 + 1 / (P**2 + 1)), {"p": (0.1, 0.9)}))
    assert not list(models_at_roots(lure(1 + 0 * P), {"p": (0.1, 0.9)}))


def test_ranks_that_fall_at_one_value():
    for u, root in (UNITS[0], UNITS[2]):
        part = check(lure(u(P) ** 2), parameters={"p": (0.1, 0.9)}, quick=True)["5.1"]
        assert part.verdict == "violated"
        assert abs(part.witness["p"] - float(root)) < 1e-15
        assert check(lure(u(P) ** 2 + 1e-20), parameters={"p": (0.1, 0.9)}, quick=True)["5.1"].verdict != "violated"


def test_an_operator_that_is_monotone_but_near_one_value():
    for less, verdict in ((1e-20, "violated"), (-1e-20, "holds")):
        S = ((P**2 - 2) ** 2 - less) * X
        model = MonotoneInclusion(x=X, field=[0 * X], operator=[S], x0=[0.5], parameters={P: 1.5}, **TIMES)
        report = check(model, parameters={"p": (1, 2)}, quick=True)
        assert (report["M-T"].verdict, report["M-A3"].verdict) == (verdict, verdict)


def test_sets_and_laws_that_touch_at_one_time():
    for width in ((T**2 - 0.3) ** 2, ca.sin(4 * T + 1) ** 2):
        model = MonotoneInclusion(x=X, field=[0 * X], lower=-width, upper=width, x0=[0.0], t=T, **TIMES)
        part = check(model, quick=True)["M-C"]
        assert part.verdict == "violated"
        assert 0.53 < part.witness["t"] < 0.55
    wide = MonotoneInclusion(x=X, field=[0 * X], lower=-1e-9, upper=(T**2 - 0.3) ** 2, x0=[0.0], t=T, **TIMES)
    assert check(wide, quick=True)["M-C"].verdict != "violated"
    law = relay(1, -((T - 0.3) ** 2), (T - 0.3) ** 2)
    report = check(LureSystem(x=X, t=T, A=[[-1]], B=[1], C=[1], law=law, x0=[1], **TIMES), quick=True)
    assert (report["3.1"].verdict, report["3.1"].witness["t of the law"]) == ("violated", 0.3)
    assert report["7.1"].verdict == "holds"


@pytest.mark.parametrize("k", [0, 1, 2, 5])
@pytest.mark.long
def test_constraints_that_oppose_each_other_at_one_time(k):
    u, root = UNITS[k]
    q = ca.SX.sym("q", 2)
    for gap, verdict in ((0.0, "violated"), (1e-9, "holds")):
        width = u(T) ** 2 + gap
        strip = {"floor": q[0] - q[1] / 3, "ceiling": width - q[0] + q[1] / 3}
        discs = {"disc": ca.norm_2(q) - 1, "other": ca.norm_2(q - ca.vertcat(3 + width, 0)) - 2}
        for constraints, start in ((strip, [0, 0]), (discs, [0, 5])):
            model = SweepingProcess(q=q, f=[0 * X, 0], constraints=constraints, q0=start, t=T, **TIMES)
            for part in (check(model, quick=True)[which] for which in ("A5", "A5'")):
                assert part.verdict == (verdict if constraints is strip or not gap else part.verdict)
                assert part.verdict != "violated" or abs(part.witness["t"] - float(root)) < 1e-15
                assert gap == 0 or part.verdict != "violated"
