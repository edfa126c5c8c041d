"""Values of parameters with which an entry of a model is finite nowhere are refused before a run, by name."""

import casadi as ca
import pytest

from nsmodel import (
    Contact,
    FirstOrderSystem,
    FrictionOscillator,
    LureSystem,
    MechanicalSystem,
    MonotoneInclusion,
    UsageError,
    check,
    prepare,
    relay,
    simulate,
)

K, X, L, Q, V, TIME = (ca.SX.sym(name) for name in "kxlqvt")


def lure(**given):
    return LureSystem(**{"A": [[-1]], "B": [[1]], "C": [[1]], "law": relay(1), "x0": [1]} | RUN | given)


def first_order(**given):
    return FirstOrderSystem(**{"x": X, "lam": L, "f": [-X], "g": [L], "h": [X], "law": relay(1), "x0": [1]} | RUN | given)


def mechanical(**given):
    fields = {"q": Q, "v": V, "M": [[1]], "F": [-10], "contacts": {"floor": Contact(gap=Q)}, "q0": [1], "v0": [0]}
    return MechanicalSystem(**fields | RUN | given)


RUN = {"t_end": 1, "step": 0.1, "parameters": {K: 0.0}}
UNDEFINED = {
    "A": lambda: lure(A=[[-1 / K]]),
    "A ": lambda: lure(A=[[1 / K**2 - 3 / K]]),  # inf - inf, of which CasADi makes 0.
    "B": lambda: lure(B=[[1 / K]]),
    "C": lambda: lure(C=[[ca.log(K)]]),
    "D": lambda: lure(D=[[1 / K]]),
    "e": lambda: lure(e=[1 / K]),
    "f": lambda: first_order(f=[X * ca.sqrt(K - 1)]),
    "f\\[1\\]": lambda: first_order(x=ca.vertcat(Q, V), f=[V, Q * ca.log(K)], g=[L, 0], h=[Q], x0=[1, 1]),
    "g": lambda: first_order(g=[L / K]),
    "h": lambda: first_order(h=[X / K]),
    "M": lambda: first_order(M=[[1 / K]]),
    "x0": lambda: first_order(x0=[1 / K]),
    "potential": lambda: FrictionOscillator(x=X, potential=X**2 * ca.log(K), x0=[1], v0=[0], **RUN),
    "phi": lambda: MonotoneInclusion(x=X, field=[-X], phi=X**2 / K, x0=[1], **RUN),
    "contacts\\['floor'\\].gap": lambda: mechanical(contacts={"floor": Contact(gap=Q / K)}),
}


@pytest.mark.parametrize("entry", UNDEFINED)
def test_entries_that_are_finite_nowhere_are_refused_by_name(entry):
    model = UNDEFINED[entry]()
    for run in (simulate, lambda model: simulate(model, rtol=1e-6), lambda model: prepare(model).run(), check):
        with pytest.raises(UsageError, match=f"with k = 0, {entry.strip()} = .*expected a finite number"):
            run(model)
    assert simulate(model, parameters={"k": 2.0}).t[-1] == 1


@pytest.mark.parametrize("f", [-ca.exp(-(X**2) / K), -ca.fmin(X, 1 / K), ca.if_else(K == 0, -X, X / K), -X * ca.sqrt(X - K)])
def test_what_is_finite_somewhere_is_run(f):
    """exp(-inf) = 0, min(x, inf) = x, a branch that is not taken; sqrt(x), of which no part of k alone is undefined."""
    assert simulate(first_order(f=[f]), t_end=0.1).x[-1, 0] < 1
