"""The affine problem y = W l + b, -y ∈ N_K(l) in C against its Python reference, on random problems."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import optimised
from fuzz_models import share

from nsmodel._utils import EPS
from nsmodel.codegen import fragments, laws, structs
from nsmodel.codegen.fragments import prune_unused, read_fragment
from nsmodel.modeling.laws import Law, ball, box, product, second_order_cone
from nsmodel.solvers import active_set, mlcp
from nsmodel.solvers import mlcp as curved
from nsmodel.solvers.constant_matrices import _multiplier_map
from nsmodel.solvers.friction_contacts import MAX_MODES, is_in_the_plane, mode_count
from nsmodel.solvers.residuals import ROUNDING, NumericLaw, law_residual, numeric_law, output_scale
from nsmodel.solvers.rounding_errors import UNIT_ROUND_OFF
from tests.solvers.test_solvers import DEGENERATE, INF, LAWS, PSD, infeasible, matrix, point_of_graph, problem, random_law, spd

COMPILER = shutil.which("gcc") or shutil.which("cc")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
ACCEPTED = 1e-10
CHAIN = (mlcp.INDEX_SET, mlcp.LEMKE, mlcp.ENUMERATION)
SOLVERS = ("none", "last index set", mlcp.INDEX_SET, mlcp.LEMKE, mlcp.ENUMERATION, mlcp.SEMISMOOTH)
ROWS = 12
EMPTY = NumericLaw(np.zeros(0), np.zeros(0), ())
CURVED_LAWS = {
    "ball": ball(3, 1.3),
    "cone": second_order_cone(3),
    "ball of radius 0": ball(2, 0),
    "product": product(box([-1, 0], [1, INF]), ball(2, 0.7), second_order_cone(3)),
}

pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")


# ---------------------------------------------------------------------------------------------- the harness


PRELUDE = """
#include <float.h>
#include <math.h>
#include <stdio.h>
#include <string.h>
#define EPS DBL_EPSILON
{constants}
#define MODEL_ROWS {rows}
#define MODEL_M {m}
#define MODEL_LEMKE {lemke}
#define MODEL_LINEAR {lemke}
#define MODEL_CURVED {curved}
typedef struct {{
{members}
    long spent, budget;
}} model_solver;
{common}
"""
TABLES = """
#include <float.h>
static const double lower[] = {{{lower}}}, upper[] = {{{upper}}};
#define LOWER lower
"""
ENTRY = """
static model_solver solver = {.budget = 2147483647};
int harness_solve(int m, const double *W, const double *b, const double *lo, const double *up, double *l, signed char *code,
                  double accepted, double *residual)
{
    const int found = affine_solve(&solver, m, W, b, LO, UP, l, code, accepted);
    *residual = solver.affine.residual;
    return found;
}
double harness_residual(int m, const double *lo, const double *up, const double *b, const double *terms, const double *w_max,
                        const double *l, const double *y)
{
    output_scale(m, b, terms, w_max, solver.affine.s_y);
    return law_residual(&solver, m, LO, UP, l, y, solver.affine.s_y, w_max);
}
int harness_linear(int n, const double *A, double *x) { return solve_or_least_squares(&solver, n, A, x); }
"""
BOX_ENTRY = """
int harness_lemke(int m, const double *W, const double *b, const double *lo, const double *up, double *l)
{
    const affine_problem problem = {m, W, b, lo, up};
    const int failed = lemke(&solver, &problem);
    memcpy(l, solver.lemke.l, m*sizeof *l);
    return failed;
}
int harness_invert(int n, const double *A, double *inverse) { return invert(&solver, n, A, inverse); }
int harness_index_sets(int m, const double *lo, const double *up, const signed char *last, int most, signed char *codes)
{
    int count = 0;
    if (!first_index_set(&solver, m, lo, up, last))
        return 0;
    do
        this_index_set(&solver, m, codes + m * count++);
    while (count < most && next_index_set(&solver, lo, up));
    return count;
}
"""
CURVED_ENTRY = """
int harness_newton(int m, const double *W, const double *b, int sweeps, double *l)
{
    const affine_problem problem = {m, W, b, lower, upper};
    memcpy(solver.semismooth.l, l, m*sizeof *l);
    block_scale(&solver, &problem);
    if (sweeps)
        gauss_seidel(&solver, &problem);
    const int failed = !sweeps && semismooth_newton(&solver, &problem);
    memcpy(l, solver.semismooth.l, m*sizeof *l);
    return failed;
}
"""
MAIN = """
int main(int count, char **argument)
{
    static double data[4 * 12 + 144];
    double residual, accepted = 1e-10;
    signed char code[12];
    int m, solved = 0;
    FILE *problems = count == 2 ? fopen(argument[1], "rb") : NULL;
    if (!problems)
        return 2;
    while (fread(&m, sizeof m, 1, problems) == 1) {
        double *W = data, *b = W + m * m, *lo = b + m, *up = lo + m, *l = up + m;
        if (fread(data, sizeof *data, m * m + 4 * m, problems) != (size_t)(m * m + 4 * m)
            || fread(code, 1, m, problems) != (size_t)m)
            return 3;
        solved += harness_solve(m, W, b, lo, up, l, code, accepted, &residual) != NONE;
    }
    printf("%d\\n", solved);
    return fclose(problems);
}
"""


def joined(values):
    return ", ".join("INFINITY" if v == INF else "-INFINITY" if v == -INF else repr(float(v)) for v in values)


def source(of: Law | None = None, *, both: bool = False, main: bool = False, rows: int = ROWS, lemke: int = 2 * ROWS) -> str:
    """The C text: for boxes given at each call, for the law ``of`` with curved sets, or for both."""
    law = EMPTY if of is None else numeric_law(of)
    flags = {"AFFINE_PROBLEM", *(("CURVED",) if law.curved else ())}
    if not law.is_normal_cone:
        flags |= {"FRICTION", *(("CONTACTS_IN_PLANE",) if mode_count(law) <= MAX_MODES and is_in_the_plane(law) else ())}
    box_too = both or not law.curved
    if box_too:
        flags |= {"BOX_PROBLEM", "ENUMERATION", "INDEX_SETS", "INVERSE", "INVERTED", "FIXED_MAPS", "PIVOTING"}
    m = law.size if law.curved else rows
    members = read_fragment("members_affine.h", flags, {})
    text = PRELUDE.format(
        rows=max(m, rows) if box_too else m,
        m=m,
        lemke=lemke if box_too else m,
        curved=len(law.curved),
        constants=fragments.define_lines(fragments.STEP_CONSTANTS),
        members=members,
        common=read_fragment("common.c", frozenset(), {}).replace("static double sign_of", "double sign_of"),
    )
    if of is not None:
        block, numbers = max(part.size for _, part in laws.curved_blocks(of)), max(1, laws.curved_block_numbers(of).numel())
        text += f"#define MODEL_BLOCK {block}\n#define MODEL_NUMBERS {numbers}\n"
        text += TABLES.format(lower=joined(law.lower), upper=joined(law.upper)) + laws.curved_sets_code(of, False)
    parts = ["solvers.c", "linear.c", "affine.c", *(["lemke.c"] if box_too else []), *(["curved.c"] if law.curved else [])]
    text += "\n".join(
        read_fragment(part, flags, {"SOLVERS": structs.solver_enum(), "ROW_RESIDUAL": laws.row_residual_code()}) for part in parts
    )
    choose = "#define LO (lo ? lo : lower)\n#define UP (up ? up : upper)\n" if law.curved else "#define LO lo\n#define UP up\n"
    text += choose + ENTRY + (BOX_ENTRY if box_too else "") + (CURVED_ENTRY if law.curved else "") + (MAIN if main else "")
    return prune_unused(text) if law.curved else text


def compiled(folder: Path, text: str, *options: str, name: str) -> Path:
    """Compile with the flags a generated library has to bear."""
    code, out = folder / f"{name}.c", folder / f"{name}.bin"
    code.write_text(text)
    done = subprocess.run([COMPILER, *STRICT, *options, str(code), "-o", str(out), "-lm"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out


@dataclass(frozen=True)
class Answer:
    solver: str
    l: np.ndarray
    code: np.ndarray
    residual: float


class Library:
    """The harness, called through ctypes."""

    def __init__(self, path: Path) -> None:
        self.c = ctypes.CDLL(str(path))
        self.c.harness_residual.restype = ctypes.c_double

    def solve(self, W, b, law, warm=None, index=None, accepted=ACCEPTED) -> Answer:
        W, b = np.ascontiguousarray(W, float), np.ascontiguousarray(b, float)
        l = np.zeros(law.size) if warm is None else np.array(warm, float)
        code = np.zeros(law.size, np.int8) if index is None else np.array(index, np.int8)
        residual = ctypes.c_double()
        found = self.c.harness_solve(
            law.size, data(W), data(b), *self._bounds(law), data(l), data(code), ctypes.c_double(accepted), ctypes.byref(residual)
        )
        return Answer(SOLVERS[found], l, code, residual.value)

    def residual(self, W, b, law, l) -> float:
        W = np.asarray(W, float)
        y, terms, w_max = W @ l + b, np.abs(W) @ np.abs(l), np.abs(W).max(axis=1)
        return self.judge(law, b, terms, w_max, l, y)

    def judge(self, law, b, terms, w_max, l, y) -> float:
        return self.c.harness_residual(
            law.size, *self._bounds(law), *(data(np.asarray(v, float)) for v in (b, terms, w_max, l, y))
        )

    def linear(self, A, x) -> np.ndarray | None:
        x = np.array(x, float)
        return None if self.c.harness_linear(len(x), data(np.ascontiguousarray(A, float)), data(x)) else x

    def lemke(self, W, b, law) -> np.ndarray | None:
        l, W = np.empty(law.size), np.ascontiguousarray(W, float)
        failed = self.c.harness_lemke(law.size, data(W), data(b), *self._bounds(law), data(l))
        return None if failed else l

    def newton(self, W, b, l, sweeps=False) -> np.ndarray | None:
        l = np.array(l, float)
        failed = self.c.harness_newton(l.size, data(np.ascontiguousarray(W)), data(b), int(sweeps), data(l))
        return None if failed else l

    def invert(self, A) -> np.ndarray | None:
        A, inverse = np.ascontiguousarray(A, float), np.empty(np.shape(A))
        return None if self.c.harness_invert(len(A), data(A), data(inverse)) > 0 else inverse

    def index_sets(self, law, last, most) -> list[tuple[int, ...]]:
        codes = np.zeros((most, law.size), np.int8)
        count = self.c.harness_index_sets(
            law.size, data(law.lower), data(law.upper), data(np.array(last, np.int8)), most, data(codes)
        )
        return [tuple(code) for code in codes[:count].tolist()]

    @staticmethod
    def _bounds(law):
        """A law with balls or cones is the library's own."""
        return (None, None) if law.curved else (data(law.lower), data(law.upper))


def data(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


@pytest.fixture(scope="session")
def boxes(tmp_path_factory) -> Library:
    return Library(compiled(tmp_path_factory.mktemp("c"), source(), optimised("-O2"), "-shared", "-fPIC", name="boxes"))


@pytest.fixture(scope="session")
def on_law(tmp_path_factory):
    """on_law(name) -> (law, library compiled for it)."""

    @cache
    def build(name: str) -> tuple[NumericLaw, Library]:
        of = CURVED_LAWS[name]
        law = numeric_law(of)
        folder = tmp_path_factory.mktemp("c")
        return law, Library(compiled(folder, source(of), optimised("-O2"), "-shared", "-fPIC", name="curved"))

    return build


def start_set(seed: int, law: NumericLaw) -> np.ndarray:
    """A random index set to start from, infinite bounds included."""
    return np.random.default_rng(seed).integers(-1, 2, law.size).astype(np.int8)


def worst(W, b, law, l) -> float:
    """The residual that Python sees."""
    return float(mlcp.affine_law_residual(W, b, law, l).max(initial=0.0))


def assert_as_good_as_python(library: Library, W, b, law, index, chain=CHAIN, warm=None) -> Answer:
    """An answer is verified by Python's residual, and there is one wherever Python's own solvers have one."""
    warm = np.zeros(law.size) if warm is None else warm
    answer = library.solve(W, b, law, warm, index)
    if answer.solver == "none":
        assert mlcp.solve_mlcp(W, b, law, warm, index, chain, False, ACCEPTED).residual > ACCEPTED
    else:
        assert worst(W, b, law, answer.l) == pytest.approx(answer.residual, rel=1e-3, abs=1e-14)
        assert answer.residual <= ACCEPTED
    return answer


# ---------------------------------------------------------------------------------------------- boxes


@pytest.mark.parametrize("letters", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("kind", [*PSD, "P"])
def test_every_solvable_problem_is_solved(boxes, kind, letters):
    """Nonmonotone "P" too: with enumeration behind it. From a random index set; m from 1 to 12."""
    for seed in range(25):
        W, b, law, _, _ = problem(seed, kind, letters, 1, 13 if kind != "P" else 7, ties=0.1 * (seed % 2))
        index = start_set(seed, law)
        answer = assert_as_good_as_python(boxes, W, b, law, index)
        assert answer.solver != "none"
        if kind == "spd":
            expected = mlcp.solve_mlcp(W, b, law, np.zeros(law.size), index, CHAIN, True, ACCEPTED)
            np.testing.assert_allclose(answer.l, expected.l, rtol=1e-9, atol=1e-9 * np.abs(expected.l).max())
            assert answer.solver == expected.solver
            if not (seed % 2 or "p" in letters):  # at a tie, as in a box that is a point, the code is a matter of round-off
                np.testing.assert_array_equal(answer.code, expected.index)


def test_each_solver_of_the_chain_answers_where_its_turn_comes(boxes):
    """From the right index set the first one; from a random one, and with a random W, every one."""
    found = set()
    for seed in range(40):
        W, b, law, _, y = problem(seed, "spd", "ecru", ties=0)
        right = np.where(y > 0, -1, np.where(y < 0, 1, 0)).astype(np.int8)
        answer = boxes.solve(W, b, law, index=right)
        assert answer.solver == mlcp.INDEX_SET
        np.testing.assert_array_equal(answer.code, right)
        rng = np.random.default_rng(seed)
        W = rng.normal(size=W.shape)
        l, y = point_of_graph(rng, law)
        found.add(assert_as_good_as_python(boxes, W, y - W @ l, law, start_set(seed, law)).solver)
    assert found == {mlcp.INDEX_SET, mlcp.LEMKE, mlcp.ENUMERATION}


@pytest.mark.parametrize("kind", ["spd", "psd", "corank 1", "nonsymmetric", "skew"])
def test_units_do_not_matter(boxes, kind):
    """l_i in units from 1e-9 to 1e9, and y in its own."""
    for seed in range(20):
        W, b, law, l, _ = problem(seed, kind, "ecru", 1, 9)
        rng = np.random.default_rng(seed)
        d = 10.0 ** rng.uniform(-9, 9, law.size if kind == "spd" else 1) * np.ones(law.size)
        unit = 10.0 ** rng.uniform(-9, 9)
        scaled = NumericLaw(law.lower * unit / d, law.upper * unit / d, ())
        answer = assert_as_good_as_python(boxes, d[:, None] * W * d, b * d * unit, scaled, start_set(seed, law))
        assert answer.solver != "none"
        if kind == "spd":
            np.testing.assert_allclose(answer.l * d / unit, l, atol=1e-7 * (1 + np.abs(l).max()))


@pytest.mark.parametrize("symmetric", [True, False])
def test_what_has_no_solution_gets_none(boxes, symmetric):
    for seed in range(share(40, 10)):
        W, b, _ = infeasible(seed, symmetric)
        law = NumericLaw(np.zeros(b.size), np.full(b.size, INF), ())
        answer = boxes.solve(W, b, law)
        assert answer.solver == "none"
        assert answer.residual > ACCEPTED
        if np.isfinite(answer.residual):  # the best of the answers found, not the last
            assert answer.residual == pytest.approx(worst(W, b, law, answer.l), rel=1e-6)
            best = mlcp.solve_mlcp(W, b, law, np.zeros(b.size), np.zeros(b.size, np.int8), CHAIN, symmetric, ACCEPTED)
            assert answer.residual <= 1.1 * best.residual


def test_primal_dual_moves_a_row_that_is_slightly_wrong(boxes):
    """l outside by 5e-4, then y of the wrong sign by as much: neither is settled, and one change of the set is enough."""
    law = NumericLaw(np.ones(1), np.full(1, 2.0), ())
    for b, start, l, code in ((-0.9995, 0, 1.0, -1), (-1.0005, -1, 1.0005, 0)):
        answer = boxes.solve(np.eye(1), np.array([b]), law, index=[start])
        assert (answer.solver, answer.l[0], answer.code[0]) == (mlcp.INDEX_SET, l, code)


def test_a_free_row_without_a_pivot_has_no_solution(boxes):
    law = NumericLaw(np.array([-INF]), np.array([INF]), ())
    answer = boxes.solve(np.zeros((1, 1)), np.array([1.0]), law, warm=[0.25], index=[0])
    assert answer.solver == "none"
    assert answer.residual > ACCEPTED
    assert boxes.solve(np.zeros((1, 1)), np.array([0.0]), law).solver == mlcp.INDEX_SET


@pytest.mark.parametrize("letters", LAWS.values(), ids=LAWS)
@pytest.mark.parametrize("kind", PSD)
def test_lemke_is_pythons(boxes, kind, letters):
    """Alone, without the chain around it: solutions where W is psd, larger problems too."""
    for seed in (*range(20), *DEGENERATE):
        W, b, law, _, _ = problem(seed, kind, letters)
        found = boxes.lemke(W, b, law)
        assert found is not None
        assert worst(W, b, law, found) <= max(1e-9, 10 * worst(W, b, law, active_set.lemke(W, b, law)))
    W, b, law, _, _ = problem(1, kind, letters, ROWS, ROWS + 1)
    assert worst(W, b, law, boxes.lemke(W, b, law)) <= 1e-9


@pytest.mark.parametrize(("kind", "letters", "seed"), [("corank 1", "ec", 357), ("corank 1", "ec", 381), ("skew", "ecrup", 345)])
def test_lemke_gets_past_a_ray_that_is_round_off(boxes, kind, letters, seed):
    """On these the path of W ends in a ray though there is a solution; that of W + 1e-7 I does not."""
    W, b, law, _, _ = problem(seed, kind, letters)
    found = boxes.lemke(W, b, law)
    assert found is not None
    assert worst(W, b, law, found) <= 1e-8


def test_lemke_with_free_rows_and_a_singular_matrix(boxes):
    """The free rows' own block is singular, and they are split into two: degenerate pivots all along."""
    for seed in (*range(30), 425, 715, 1370):
        rng = np.random.default_rng(seed)
        A = rng.normal(size=(4, 3))
        law = NumericLaw(np.where(rng.random(4) < 0.6, -INF, 0.0), np.full(4, INF), ())
        l, y = point_of_graph(rng, law)
        for W in (A @ A.T, A @ A.T + np.triu(np.ones((4, 4)), 1) - np.tril(np.ones((4, 4)), -1)):
            found = boxes.lemke(W, y - W @ l, law)
            assert found is not None
            assert worst(W, y - W @ l, law, found) <= 1e-9


def test_lemke_on_degenerate_problems_of_small_integers(boxes):
    """Ties all along: without the covering variable's precedence at a tie these end elsewhere."""
    for seed in (51, 90, 138, 195, 229, 334):
        rng = np.random.default_rng(seed)
        m = int(rng.integers(2, 8))
        low, S = rng.integers(-1, 2, size=(m, max(1, m // 2))), np.triu(rng.integers(-1, 2, size=(m, m)), 1)
        W, law = (low @ low.T + (S - S.T) * (seed % 2)).astype(float), random_law(rng, m, "ecr")
        law = NumericLaw(np.round(law.lower), np.round(law.upper), ())
        l = np.clip(rng.integers(-1, 2, m), law.lower, law.upper)
        at_lower, at_upper = l == law.lower, (l == law.upper) & (l != law.lower)
        y = np.where(at_lower, rng.integers(0, 2, m), 0) - np.where(at_upper, rng.integers(0, 2, m), 0)
        found = boxes.lemke(W, y - W @ l, law)
        assert found is not None
        assert worst(W, y - W @ l, law, found) <= 1e-8


def test_lemke_does_not_care_about_units(boxes):
    for seed in range(30):
        W, b, law, l, _ = problem(seed, "spd", "ecr")
        rng = np.random.default_rng(seed)
        d, unit = 10.0 ** rng.uniform(-9, 9, law.size), 10.0 ** rng.uniform(-9, 9)
        found = boxes.lemke(d[:, None] * W * d, b * d * unit, NumericLaw(law.lower * unit / d, law.upper * unit / d, ()))
        assert found is not None
        np.testing.assert_allclose(found * d / unit, l, atol=1e-7 * (1 + np.abs(l).max()))


@pytest.mark.parametrize("symmetric", [True, False])
def test_lemke_ends_in_a_ray_where_there_is_no_solution(boxes, symmetric):
    for seed in range(40):
        W, b, _ = infeasible(seed, symmetric)
        assert boxes.lemke(W, b, NumericLaw(np.zeros(b.size), np.full(b.size, INF), ())) is None


@pytest.mark.parametrize("letters", ["c", "r", "e", "ecrup"])
def test_index_sets_come_in_pythons_order(boxes, letters):
    for seed in range(12):
        rng = np.random.default_rng(seed)
        law = random_law(rng, int(rng.integers(1, 7)), letters)
        last = start_set(seed, law)
        expected = [tuple(code) for code in active_set.enumerate_index_sets(law, last)]
        assert boxes.index_sets(law, last, 4000) == expected


def test_index_sets_of_a_large_law_are_not_enumerated(boxes):
    relays = NumericLaw(-np.ones(ROWS), np.ones(ROWS), ())
    assert boxes.index_sets(relays, np.zeros(ROWS), 10) == []
    bilateral = NumericLaw(np.full(ROWS, -INF), np.full(ROWS, INF), ())
    assert boxes.index_sets(bilateral, np.zeros(ROWS), 10) == [(0,) * ROWS]


def test_answers_do_not_depend_on_what_was_solved_before(boxes):
    """All work arrays are written before they are read: the same bits whatever came in between."""
    questions = []
    for seed in range(30):
        W, b, law, _, _ = problem(seed, (*PSD, "P")[seed % 8], "ecru", 1, 8)
        questions.append((W, b, law, None, start_set(seed, law)))
    first = [boxes.solve(*question) for question in questions]
    for one, question in reversed(list(zip(first, questions, strict=True))):
        two = boxes.solve(*question)
        assert (one.solver, one.l.tobytes(), one.code.tobytes()) == (two.solver, two.l.tobytes(), two.code.tobytes())


def test_a_law_that_is_larger_than_what_was_declared_is_refused(tmp_path):
    """Room for 3 rows and no slack: two bounds in one row do not fit, and nothing is written where there is no room."""
    library = Library(compiled(tmp_path, source(rows=3, lemke=3), optimised("-O2"), "-shared", "-fPIC", name="tight"))
    W, b = spd(np.random.default_rng(0), 3), -np.ones(3)
    assert library.lemke(W, b, NumericLaw(np.zeros(3), np.full(3, INF), ())) is not None
    assert library.lemke(W, b, NumericLaw(np.zeros(3), np.array([INF, INF, 1.0]), ())) is None
    assert library.lemke(W, b, NumericLaw(np.array([0, -INF, 0]), np.full(3, INF), ())) is None


@pytest.mark.parametrize("rows", [1, 2])
def test_the_text_compiles_without_a_warning_where_sizes_are_known(tmp_path, rows):
    """With the number of rows a constant the compiler looks into every array."""
    text = source(rows=rows, lemke=rows).replace(
        "affine_solve(&solver, m, ", "affine_solve(&solver, m ? MODEL_ROWS : MODEL_ROWS, "
    )
    compiled(tmp_path, text, "-O3", "-shared", "-fPIC", name="small")


# ---------------------------------------------------------------------------------------------- the residual


def random_points(law, seed):
    """(b, |W| |l|, w_max, l, y) that solve nothing: all branches of the residual, over many sizes."""
    rng = np.random.default_rng(seed)
    m = law.size
    size = 10.0 ** rng.uniform(-6, 6, (5, m))
    b, l, y = rng.normal(size=(3, m)) * size[:3] * (rng.random((3, m)) < 0.8)
    at = rng.integers(0, 3, m)
    l = np.where((at == 1) & np.isfinite(law.lower), law.lower, np.where((at == 2) & np.isfinite(law.upper), law.upper, l))
    w_max = size[3] * (rng.random(m) < 0.9)
    return b, w_max * size[4], w_max, l, y


def test_the_residual_is_pythons(boxes, on_law):
    compared = []
    for seed in range(240):
        rng = np.random.default_rng(seed)
        law, library = (random_law(rng, int(rng.integers(1, 9)), "ecrup"), boxes) if seed % 2 else on_law("product")
        b, terms, w_max, l, y = random_points(law, seed)
        if seed % 3 == 0:
            y = y * 1e-12
        expected = law_residual(law, l, y, output_scale(b, terms, w_max), w_max).max()
        found = library.judge(law, b, terms, w_max, l, y)
        assert found == pytest.approx(expected, rel=1e-12)
        compared.append(found)
    assert np.quantile(compared, 0.1) < 1e-3
    assert np.quantile(compared, 0.9) > 1e3


@pytest.mark.parametrize("value", [np.nan, INF, -INF])
def test_the_residual_of_what_is_not_finite_is_infinite(boxes, value):
    law = NumericLaw(np.zeros(2), np.ones(2), ())
    good = [np.zeros(2), np.zeros(2), np.ones(2), np.zeros(2), np.zeros(2)]
    assert boxes.judge(law, *good) == 0
    for place in (2, 3, 4):  # w_max, l, y
        bad = [v.copy() for v in good]
        bad[place][1] = value
        assert boxes.judge(law, *bad) == INF


# ---------------------------------------------------------------------------------------------- linear systems


def test_linear_systems_are_solved_to_round_off_in_every_row(boxes):
    """With one refinement the residual of each row is round-off of that row, whatever its unit."""
    for seed in range(200):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(1, ROWS))
        A, x = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-8, 8, (n, 1)), rng.normal(size=n)
        rhs = A @ x
        found = boxes.linear(A, rhs)
        left = np.abs((A.astype(np.longdouble) @ found.astype(np.longdouble) - rhs).astype(float))
        assert np.all(left <= 2 * EPS * (np.abs(A) @ np.abs(found) + np.abs(rhs)))


@pytest.mark.parametrize("size", [1e-200, 1.0, 1e200])
def test_singular_systems_get_the_solution_of_least_norm(boxes, size):
    for seed in range(60):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(2, ROWS))
        low = rng.integers(-3, 4, size=(n, int(rng.integers(1, n)))).astype(float)  # exact: singular without round-off
        A, rhs = low @ low.T * size, rng.normal(size=n)
        expected = np.linalg.lstsq(A / size, rhs, rcond=None)[0] / size
        np.testing.assert_allclose(boxes.linear(A, rhs) * size, expected * size, atol=1e-9 * (size * np.abs(expected)).max())
    np.testing.assert_array_equal(boxes.linear(np.zeros((3, 3)), np.ones(3)), 0)


def test_what_counts_as_singular_is_a_matter_of_round_off(boxes):
    for small, inverse in ((1e-9, 1e9), (1e-17, 0)):
        found = boxes.linear(np.diag([1.0, small, 0.0]), np.ones(3))
        np.testing.assert_allclose(found, [1, inverse, 0], rtol=1e-14)


def test_inverses_are_those_of_the_kernel(boxes):
    """Regular blocks and singular ones; on a free law the kernel's map is -inverse."""
    for seed in range(60):
        rng = np.random.default_rng(seed)
        m = int(rng.integers(1, 9))
        low = rng.integers(-3, 4, size=(m, max(1, m - 2))).astype(float)
        for W in (matrix(rng, "spd", m), low @ low.T):
            found = _multiplier_map(W, NumericLaw(np.full(m, -INF), np.full(m, INF), ()), np.zeros(m, np.int8))
            assert found is not None
            np.testing.assert_allclose(boxes.invert(W), -found[0], atol=1e-9 * np.abs(found[0]).max())


def test_linear_systems_with_nan_or_inf_are_refused(boxes):
    for value in (np.nan, INF, -INF):
        for place in range(9):
            A = np.eye(3) + 0.1
            A.flat[place] = value
            assert boxes.linear(A, np.ones(3)) is None
            assert boxes.invert(A) is None
        for place in range(3):
            rhs = np.ones(3)
            rhs[place] = value
            assert boxes.linear(np.eye(3), rhs) is None


# ---------------------------------------------------------------------------------------------- balls and cones


@pytest.mark.parametrize("kind", ["spd", "corank 1", "duplicate rows", "nonsymmetric"])
@pytest.mark.parametrize("name", CURVED_LAWS)
def test_balls_and_cones_are_solved_as_in_python(on_law, name, kind):
    law, library = on_law(name)
    solved = set()
    for seed in range(share(16, 5)):
        rng = np.random.default_rng(seed)
        m = law.size
        W, b = matrix(rng, kind, m), rng.normal(size=m) * 10.0 ** rng.uniform(-2, 2)
        warm = rng.normal(size=m)
        expected = mlcp.solve_mlcp(W, b, law, warm, np.zeros(m, np.int8), (mlcp.SEMISMOOTH,), False, ACCEPTED)
        answer = library.solve(W, b, law, warm)
        assert (answer.solver == mlcp.SEMISMOOTH) == (expected.residual <= ACCEPTED)
        solved.add(answer.solver)
        if answer.solver != "none":
            assert worst(W, b, law, answer.l) == pytest.approx(answer.residual, rel=1e-3, abs=1e-14)
            np.testing.assert_array_equal(answer.code, expected.index)
        if kind == "spd":
            np.testing.assert_allclose(answer.l, expected.l, rtol=1e-9, atol=1e-9 * np.abs(expected.l).max())
    assert mlcp.SEMISMOOTH in solved


@pytest.mark.parametrize("kind", ["spd", "nonsymmetric"])
@pytest.mark.parametrize("name", ["ball", "cone", "product"])
def test_newton_and_gauss_seidel_alone_are_pythons(on_law, name, kind):
    """They converge from the same starts, to the same point; full steps alone would not, on the ball with a nonsymmetric W."""
    law, library = on_law(name)
    for seed in range(50):
        rng = np.random.default_rng(seed)
        W, b = matrix(rng, kind, law.size) + 0.05 * np.eye(law.size), rng.normal(size=law.size) * 10.0 ** rng.uniform(-2, 2)
        start = rng.normal(size=law.size)
        expected, found = curved.semismooth_newton(W, b, law, start), library.newton(W, b, start)
        assert expected is not None
        assert found is not None
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
        if kind == "spd" and seed < 10:
            expected = curved.projected_gauss_seidel(W, b, law, start)
            np.testing.assert_allclose(library.newton(W, b, start, sweeps=True), expected, atol=1e-7 * np.abs(expected).max())


def test_a_ball_is_solved_from_its_secular_equation(on_law):
    """min l'Wl/2 + b'l over |l| <= r: the independent check, (W + mu I) l = -b with |l| = r."""
    law, library = on_law("ball")
    outside = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        W, b = spd(rng, 3), rng.normal(size=3) * 10.0 ** rng.uniform(-2, 2)
        l = library.solve(W, b, law).l
        y = W @ l + b
        if np.linalg.norm(np.linalg.solve(W, b)) <= 1.3:
            np.testing.assert_allclose(l, -np.linalg.solve(W, b), rtol=1e-9)
        else:
            outside += 1
            assert np.linalg.norm(l) == pytest.approx(1.3, rel=2 * EPS)
            np.testing.assert_allclose(y / np.linalg.norm(y), -l / 1.3, atol=1e-6)
    assert 5 < outside < 35


def test_a_library_may_have_its_own_curved_law_and_boxes_besides(tmp_path):
    """The law is the model's own where the bounds are its own tables, whatever the number of rows."""
    law = numeric_law(CURVED_LAWS["product"])
    text = source(CURVED_LAWS["product"], both=True)
    library = Library(compiled(tmp_path, text, optimised("-O1"), "-shared", "-fPIC", name="both"))
    for seed in range(10):
        rng = np.random.default_rng(seed)
        W, b = spd(rng, law.size), rng.normal(size=law.size)
        assert library.solve(W, b, law).solver == mlcp.SEMISMOOTH
        W, b, other, l, _ = problem(seed, "spd", "ecru", law.size, law.size + 1)
        answer = library.solve(W, b, other)
        assert answer.solver in CHAIN
        np.testing.assert_allclose(answer.l, l, atol=1e-8)


# ---------------------------------------------------------------------------------------------- hostile numbers


def hostile(rng, m):
    """(W, b) whose entries are NaN, infinite, huge, tiny or 0 here and there."""
    values = np.array([np.nan, INF, -INF, 1e308, -1e308, 1e200, 1e-200, 5e-324, 0.0, 1.0])
    W, b = matrix(rng, rng.choice(["spd", "skew"]), m), rng.normal(size=m)
    for part in (W, b):
        chosen = rng.random(part.shape) < rng.choice([0.05, 0.5])
        part[chosen] = rng.choice(values if rng.random() < 0.5 else values[3:], chosen.sum())
    return W, b


def test_hostile_numbers_end_and_nothing_false_passes(boxes, on_law):
    """Also hostile bounds and warm starts. What is accepted, Python's residual accepts too."""
    answered = 0
    for seed in range(400):
        rng = np.random.default_rng(seed)
        law, library = (random_law(rng, int(rng.integers(1, 7)), "ecru"), boxes) if seed % 2 else on_law("product")
        if seed % 4 == 1:
            size = 10.0 ** rng.uniform(-308, 308)
            law = NumericLaw(law.lower * size, law.upper * size, ())
        W, b = hostile(rng, law.size)
        warm = rng.choice([np.nan, INF, 1e300, 0.0, 1.0], law.size)
        with np.errstate(all="ignore"):
            answer = library.solve(W, b, law, warm, start_set(seed, law))
            if not (np.isfinite(W).all() and np.isfinite(b).all()):
                assert answer.solver == "none"
                assert answer.residual == INF
                np.testing.assert_array_equal(answer.l, warm)
            elif answer.solver != "none":
                answered += 1
                assert np.isfinite(answer.l).all()
                rounding = (
                    ROUNDING * UNIT_ROUND_OFF / ACCEPTED * (np.abs(W) @ np.abs(answer.l) + np.abs(b))
                )  # sums in another order
                assert mlcp.affine_law_residual(W, b, law, answer.l, rounding).max() <= 2 * ACCEPTED
    assert answered > 50


def written(problems) -> bytes:
    """Problems as the harness's main() reads them."""
    out = b""
    for W, b, law, index in problems:
        parts = (W, b, law.lower, law.upper, np.zeros(law.size))
        out += np.int32(law.size).tobytes() + b"".join(np.ascontiguousarray(p, float).tobytes() for p in parts) + index.tobytes()
    return out


def test_sanitizers_find_nothing(tmp_path):
    """Address and undefined-behaviour sanitizers over good and hostile problems, boxes and a curved law."""
    probe = subprocess.run(
        [COMPILER, "-fsanitize=address,undefined", "-x", "c", "-", "-o", str(tmp_path / "probe")],
        input="int main(void) { return 0; }", capture_output=True, text=True,
    )  # fmt: skip
    if probe.returncode:
        pytest.skip("no sanitizers")
    law = numeric_law(CURVED_LAWS["product"])
    options = (optimised("-O1"), "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    for own, text in (
        (EMPTY, source(main=True)),
        (law, source(CURVED_LAWS["product"], main=True).replace("W, b, lo, up, l,", "W, b, 0, 0, l,")),
    ):
        problems = []
        for seed in range(200):
            rng = np.random.default_rng(seed)
            kind = (*PSD, "P")[seed % (len(PSD) + 1)]
            size = (own.size, own.size + 1) if own.size else (1, 9)
            W, b, its, _, _ = problem(seed, kind, "ecrup", *size)
            if seed % 3 == 0:
                W, b = hostile(rng, its.size)
            problems.append((W, b, its, start_set(seed, its)))
        program = compiled(tmp_path, text, *options, name="program")
        file = tmp_path / "problems"
        file.write_bytes(written(problems))
        done = subprocess.run([str(program), str(file)], capture_output=True, text=True, timeout=120)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        assert int(done.stdout) > 80
