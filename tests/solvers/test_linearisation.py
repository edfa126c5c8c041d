"""What a linearisation holds: matrices of affine steps are evaluated once, and what is 0 by its structure is not."""

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel.solvers.newton import NewtonSolver
from nsmodel.solvers.one_step_problem import one_step_problem
from nsmodel.solvers.residuals import numeric_law
from nsmodel.solvers.structure import read_step_structure

PEOPLE = 12


@pytest.fixture(scope="module")
def room():
    """A room, a step of which is affine: 60 walls and 66 pairs act on the position alone, of two people at most."""
    problem = one_step_problem(nsmodel.load("crowd_room", n=PEOPLE))
    structure = read_step_structure(problem)
    assert structure.affine
    assert not structure.constant
    assert problem.l.numel() == 126
    return problem, NewtonSolver(problem, structure, numeric_law(problem.law), 1e-9)


def random_iterates(problem, count):
    rng = np.random.default_rng(0)
    state = np.array(ca.DM(nsmodel.load("crowd_room", n=PEOPLE).q0)).ravel()
    return state, [(state + rng.normal(size=state.size), rng.normal(size=problem.l.numel())) for _ in range(count)]


def test_the_matrices_of_an_affine_step_are_those_of_all_its_iterates(room):
    problem, newton = room
    state, ((z, l), (other_z, other_l)) = random_iterates(problem, 2)
    first, second = newton.linearise(0.0, 0.02, state, z, l), newton.linearise(0.0, 0.02, state, other_z, other_l)
    assert first.J is second.J
    assert (first.Y != second.Y).all()
    for t, h, moved in ((0.0, 0.01, state), (0.0, 0.02, state + 1e-3)):
        assert newton.linearise(t, h, moved, z, l).J is not first.J
    np.testing.assert_array_equal(newton.linearise(0.0, 0.02, state, z, l).J.Y_z, first.J.Y_z)


def test_a_linearisation_has_the_numbers_of_the_dense_matrices(room):
    problem, newton = room
    state, ((z, l),) = random_iterates(problem, 1)
    symbols = [problem.t, problem.h, problem.state, problem.z, problem.l]
    dense = ca.Function("dense", symbols, [ca.densify(e) for e in (problem.E, problem.Y, *problem.jacobians)])
    E, Y, *jacobians = (np.array(part) for part in dense(0.0, 0.02, state, z, l))
    at = newton.linearise(0.0, 0.02, state, z, l)
    np.testing.assert_array_equal(at.E, E.ravel())
    np.testing.assert_array_equal(at.Y, Y.ravel())
    for own, whole in zip((at.J.E_z, at.J.E_l, at.J.Y_z, at.J.Y_l), jacobians, strict=True):
        np.testing.assert_array_equal(own, whole)
    E_z, E_l, Y_z, Y_l = jacobians
    np.testing.assert_allclose(at.J.row_change(z, l), np.concatenate([E_z @ z + E_l @ l, Y_z @ z + Y_l @ l]), rtol=1e-13)
