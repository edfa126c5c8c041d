"""Many runs in step, for small affine problems whose matrices depend on parameters alone: the functions and loops of `c/lanes.c`.

On an index set a step is an affine map of the state x, the same in all lanes but for its numbers. With z^ where nothing moves,

    z = z^ + D (x, 1),   l = L (x, 1),   b = y where l = 0 = B (x, 1),

D and L of the index set, B of the parameters. (z, l) is judged by the rows themselves: E(z^, 0) + E_z (z - z^) + E_l l
beside |E(z^, 0)| + |E_z| |z - z^|, and y beside |b|, which grows by |Y_l| |l| up to the limit of `certificate.output_scale`.
These are the scales of `c/newton.c`, or smaller ones.

What a map gives is never believed: in every lane and step E is evaluated at (z, l), l must be in its box, y of the sign that the
index set says, and a lane above `EXPLAINED` is looked at with the running error bound, then redone by `attempt()`, whose index
set makes its next map. What rows give exactly is exact in maps too. A lane's operations, and their order, are the same whoever
is beside it; loops are built for no vectors, AVX2 and AVX-512 in one library and chosen by the processor when it runs. Nothing
but sums, products and quotients is taken, nothing contracted or reassociated: bits depend on neither processor, width, order
nor chunk. They are not those of a scalar step, and the library is its own file of the cache. The fragments compile as CUDA C++
too, one lane a thread (`tests/bench/gpu.py`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import casadi as ca
import numpy as np

from nsmodel.codegen.expressions import add_graph_lines, c_function, c_number
from nsmodel.codegen.step_spec import NEWTON, StepSpec
from nsmodel.codegen.varying_steps import is_rounding_bounded_by_terms
from nsmodel.solvers.rounding_errors import rounding_error_bound

ALIGNMENT = 64  # Bytes to which the memory of lanes is aligned: a line of the cache, and the widest vector, of 512 bits.
# Unknowns and multipliers up to which steps are taken in lanes: their numbers, times the lanes, stay in the first cache.
MAX_LANE_UNKNOWNS = 16
LANE_WIDTHS = {40: 32, 400: 16}  # Numbers of a lane up to which so many are kept in step: they stay in the nearest memory.
# Operations deep to which two expressions are compared; deeper ones count as different, which only makes the code longer.
COMPARISON_DEPTH = 20


def lanes_obstacle(spec: StepSpec) -> str:
    """Why the steps of a scene are not taken in lanes; nothing where they are."""
    if spec.problem.prediction is not None or spec.path != NEWTON or not spec.for_all_values:
        return "not one library for all values of a one-step problem"
    problem, structure = spec.problem, spec.structure
    reasons = {
        "no law": not structure.m,
        "a matrix depends on more than parameters": not (structure.affine and structure.constant),
        "more than a few unknowns": structure.n + structure.m > MAX_LANE_UNKNOWNS
        or problem.state.numel() > 2 * MAX_LANE_UNKNOWNS,
        "a curved set": bool(spec.law.curved),
        "only the rows that act are solved for": spec.uses_working_set,
        "a reaction is found anew where an input jumps": spec.finds_restart_reaction or spec.ticking,
        "multipliers are rewritten": problem.multipliers is not None,
        "a projection is certified by its gap too": structure.projection or problem.overreach is not None,
    }
    for reason, holds in reasons.items():
        if holds:
            return reason
    if is_rounding_bounded_by_terms(spec):
        return "a large graph"
    parts = _AffineMaps.of(spec)
    z_l_y = ca.vertcat(problem.z, problem.l, problem.y)
    slopes = [column for affine in (parts.E, parts.Y, parts.Y_0, parts.guess) for column in (affine.J, affine.c)]
    slopes += [ca.jacobian(problem.next_state, ca.vertcat(problem.state, z_l_y)), _set_to_zero(problem.next_state, z_l_y)]
    moves = [ca.depends_on(e, ca.vertcat(problem.t, z_l_y)) for e in slopes[:-1] if e.numel()]
    curved = [ca.depends_on(e, problem.state) for e in slopes[:-1] if e.numel()]
    if any(moves) or any(curved) or ca.depends_on(problem.next_state, ca.vertcat(problem.t, problem.y)):
        return "its affine terms depend on time, or are no affine functions of the state"
    return ""


class _AffineInState(NamedTuple):
    """J x + c of the state x."""

    J: ca.SX
    c: ca.SX

    @classmethod
    def of(cls, expression: ca.SX, state: ca.SX) -> _AffineInState:
        """An expression that is affine in the state."""
        return cls(ca.sparsify(ca.jacobian(expression, state)), ca.sparsify(_set_to_zero(expression, state)))

    def columns(self, used: list[int]) -> ca.SX:
        """[J c], the columns that are used, dense."""
        return ca.densify(ca.horzcat(self.J[:, used], self.c))


class _AffineMaps(NamedTuple):
    """z^ without multipliers; E and Y there; Y at z = 0, l = 0."""

    guess: _AffineInState
    E: _AffineInState
    Y: _AffineInState
    Y_0: _AffineInState

    @classmethod
    def of(cls, spec: StepSpec) -> _AffineMaps:
        """The parts of a scene."""
        p, at = spec.problem, spec.problem.state
        guess = _set_to_zero(p.guess, p.l)
        moved = [ca.substitute([e], [p.z, p.l], [guess, ca.SX.zeros(p.l.shape)])[0] for e in (p.E, p.Y)]
        parts = guess, *moved, _set_to_zero(p.Y, ca.vertcat(p.z, p.l))
        return cls(*(_AffineInState.of(ca.densify(e), at) for e in parts))

    @property
    def used(self) -> list[int]:
        """The places of the state that a step depends on."""
        patterns = [np.array(ca.DM(part.J.sparsity(), 1.0)).reshape(part.J.shape) for part in self]
        return np.flatnonzero(np.vstack(patterns).any(axis=0)).tolist()


def _set_to_zero(expression: ca.SX, symbols: ca.SX) -> ca.SX:
    """The expression with 0 in place of symbols."""
    return ca.substitute([expression], [symbols], [ca.SX.zeros(symbols.shape)])[0]


class _ParameterNumbers:
    """Expressions of the parameters, each once, with the symbol that stands for it in a step."""

    def __init__(self) -> None:
        self.values: list[ca.SX] = []
        self.symbols: list[ca.SX] = []

    def __call__(self, matrix: ca.SX) -> ca.SX:
        """The matrix with symbols in place of entries that are no numbers."""
        found = ca.SX(matrix.sparsity(), 0)
        for k in range(matrix.nnz()):
            entry = matrix.nz[k]
            found.nz[k] = entry if entry.is_constant() else self._symbol(entry)
        return ca.sparsify(found)

    def _symbol(self, entry: ca.SX) -> ca.SX:
        for value, symbol in zip(self.values, self.symbols, strict=True):
            if ca.is_equal(value, entry, COMPARISON_DEPTH):
                return symbol
        self.values.append(entry)
        self.symbols.append(ca.SX.sym(f"number_{len(self.symbols)}"))
        return self.symbols[-1]


class _StepStatements:
    """Statements of one step of lane j."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def add(self, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX]) -> None:
        """Constants named by the outputs; {i} in the C of an input is the number of its entry."""
        function = ca.Function("f", list(inputs.values()), [ca.densify(ca.vertcat(*outputs.values()))], {"cse": True})
        keys = list(inputs)
        stores = add_graph_lines(function, lambda which, entry: keys[which].format(i=entry), self.lines)
        targets = [f"{key}_{i}" for key, e in outputs.items() for i in range(e.numel())]
        self.lines += [f"const double {targets[at]} = {piece.number.text};" for at, piece, _ in stores]


class _LaneWriter:
    """What is printed of a scene."""

    def __init__(self, spec: StepSpec) -> None:
        self.scene, self.parts, self.numbers = spec, _AffineMaps.of(spec), _ParameterNumbers()
        self.used, problem, unit = self.parts.used, spec.problem, spec.structure.unit_rows
        self.x, self.n, self.m = problem.state, spec.structure.n, spec.structure.m
        self.C = len(self.used) + 1
        Y_0 = ca.sparsify(self.parts.Y_0.columns(self.used))
        at_zero = {i for i in range(self.m) if not Y_0[i, :].nnz()}
        self.exact = {row for row, *_ in unit} & at_zero  # y is exactly 0 there, where the index set says so
        given = range(self.n) if spec.structure.rest_rows else sorted({j for _, j, _ in unit})
        self.bare = [j for j in given if not (self._is_state_entry(j) and {i for i, k, _ in unit if k == j} <= self.exact)]
        self.z, self.l = ca.SX.sym("z", self.n), ca.SX.sym("l", self.m)
        self.finite = np.isfinite(np.concatenate([spec.law.lower, spec.law.upper]))
        ends = self.finite[: self.m] & self.finite[self.m :]  # of a box with both an l is finite that is inside
        at = zip(*spec.jacobians[1].sparsity().get_triplet(), strict=True)
        self.open = sorted({i for i, j in at if not ends[j]})
        self.guess = self._evaluate_affine(self.parts.guess)
        self.rows = self._residual_rows()

    def _is_state_entry(self, j: int) -> bool:
        """Whether z^_j is a place of the state, or 0: z^_j - z^_j is exactly 0, however it is summed."""
        J, c = self.parts.guess.J[j, :], self.parts.guess.c[j]
        return not c.nnz() and J.nnz() <= 1 and all(entry.is_one() for entry in ca.vertsplit(ca.vec(J.nz[:])) if J.nnz())

    def _evaluate_affine(self, part: _AffineInState) -> ca.SX:
        return self.numbers(part.J) @ self.x + self.numbers(part.c)

    def _residual_rows(self) -> dict[str, ca.SX]:
        """What is judged, and the next state, of (z, l)."""
        problem, (E_z, E_l, Y_z, Y_l) = self.scene.problem, map(self.numbers, self.scene.jacobians)
        moved = [E_z[:, j] * (self.z[j] - self.guess[j]) for j in range(self.n)]
        still = self._evaluate_affine(self.parts.E)
        E, scale = still, ca.fabs(still)
        for part in moved:
            E, scale = E + part, scale + ca.fabs(part)
        z_l = ca.vertcat(problem.z, problem.l)
        next_of = self.numbers(ca.sparsify(ca.jacobian(problem.next_state, z_l)))
        rest = _AffineInState.of(_set_to_zero(problem.next_state, z_l), self.x)
        self.terms = ca.densify(ca.sum2(ca.fabs(Y_l @ ca.diag(self.l))))
        self.fed = sorted({i for i, _ in zip(*Y_l.sparsity().get_triplet(), strict=True)})  # rows that l itself enters
        return {
            "E": E + E_l @ self.l, "scale": scale, "y": self._evaluate_affine(self.parts.Y_0) + Y_z @ self.z + Y_l @ self.l,
            "next": self._evaluate_affine(rest) + next_of @ ca.vertcat(self.z, self.l),
        }  # fmt: skip

    def _state_map(self, name: str, rows: int) -> tuple[dict[str, ca.SX], ca.SX]:
        """A map of the state: its numbers by their C, and what it gives."""
        entries = ca.SX.sym(name, self.C * rows)
        of = ca.vertcat(*(self.x[i] for i in self.used), 1)
        given = [sum((entries[self.C * k + c] * of[c] for c in range(self.C)), ca.SX(0)) for k in range(rows)]
        return {f"g->{name}[{{i}}][j]": entries}, ca.vertcat(*given)

    def _known_symbols(self) -> dict[str, ca.SX]:
        symbols = ca.vertcat(ca.SX(0, 1), *self.numbers.symbols)
        return {"x[{i}][j]": self.x} | ({"g->numbers[{i}][j]": symbols} if symbols.numel() else {})

    def body(self, judged: list[int]) -> list[str]:
        """Statements: (z, l) on the index set, the rows, the next state, and how large y is in the rows ``judged``."""
        known, body = self._known_symbols(), _StepStatements()
        D, moved = self._state_map("of_z", self.n)
        L, l = self._state_map("of_l", self.m)
        keep = ca.SX.sym("keep", len(self.bare))
        factor = {j: keep[k] for k, j in enumerate(self.bare)}
        guess = ca.vertcat(*(self.guess[j] * factor.get(j, 1) for j in range(self.n)))
        kept = {"g->keep[{i}][j]": keep} if self.bare else {}
        body.add(known | D | L | kept, {"z": guess + moved, "l": l})
        B, b = self._state_map("of_b", self.m)
        fed = [i for i in judged if i in self.fed]
        of_b = {f"b{i}": ca.fabs(b[i]) for i in (range(self.m) if fed else judged)}
        terms = {f"terms{i}": self.terms[i] for i in fed}
        body.add(known | {"z_{i}": self.z, "l_{i}": self.l} | B, self.rows | of_b | terms)
        names = [f"b{i}_0" for i in range(self.m)]
        most = [f"const double most = {_nested_maximum([f'{names[i]}*g->per[{i}][j]' for i in range(self.m)])};"] if fed else []
        grown = "const double size_{0} = smaller({1} + terms{0}_0, larger(g->reach[{0}][j]*most, {1}));"
        sizes = [(grown if i in fed else "const double size_{0} = {1};").format(i, names[i]) for i in judged]
        return [*body.lines, *most, *sizes]

    def wrong(self, i: int) -> str:
        """How far y_i is off what its code says: |y| where it is 0, else what has the wrong sign."""
        lower, upper = self.finite[i], self.finite[self.m + i]
        above = f"g->above[{i}][j]*y_{i}" if lower else f"y_{i}"
        below = f"g->below[{i}][j]*-y_{i}" if upper else f"-y_{i}"
        return f"larger({above}, {below})"

    def residual(self, judged: list[int]) -> list[str]:
        """The residual of E, and of the law in rows ``judged``."""
        parts = [f"part_of(fabs(E_{i}), scale_{i})" for i in range(self.n)]
        parts += [f"part_of({self.wrong(i)}, size_{i})" for i in judged]
        return _maximum_lines(parts)

    def finiteness_lines(self, judged: list[int]) -> list[str]:
        """The sum that is finite where all is of which the residual and the next state are made."""
        made = [f"E_{i}" for i in self.open] + [f"scale_{i}" for i in range(self.n)]
        made += [f"{name}_{i}" for name in ("y", "size") for i in judged]
        made += [f"next_{i}" for i in range(self.rows["next"].numel())]
        return [f"const double all = {' + '.join(made)};"]

    def inside(self) -> Iterator[str]:
        """That l is in its box."""
        law = self.scene.problem.law
        for name, sign, ends, finite in (
            ("lower", ">=", ca.densify(law.lower), self.finite), ("upper", "<=", ca.densify(law.upper), self.finite[self.m :])
        ):  # fmt: skip
            for i in np.flatnonzero(finite[: self.m]).tolist():
                yield f"l_{i} {sign} {c_number(float(ends[i])).text if ends[i].is_constant() else f'g->{name}[{i}][j]'}"

    def acceptance_condition(self) -> str:
        """The condition, an int of C, that l is in its box, y exactly 0 where it must be, or of its sign, and all is finite."""
        signs = []
        for i in sorted(self.exact):
            signs += [f"y_{i} >= g->least[{i}][j]" if self.finite[self.m + i] else f"y_{i} >= 0"]
            signs += [f"y_{i} <= g->most[{i}][j]" if self.finite[i] else f"y_{i} <= 0"]
        return " & ".join(f"({test})" for test in [*signs, *self.inside(), "all - all == 0"])


def _maximum_lines(parts: list[str]) -> list[str]:
    """The largest of some numbers, in r."""
    lines = [f"const double r_{i} = {part};" for i, part in enumerate(parts)]
    return [*lines, f"const double r = {_nested_maximum([f'r_{i}' for i in range(len(parts))])};"]


def _nested_maximum(parts: list[str]) -> str:
    text = parts[0]
    for part in parts[1:]:
        text = f"larger({text}, {part})"
    return text


def _indented_lines(lines: list[str]) -> str:
    return "".join(f"            {line}\n" for line in lines)


def lanes_code(spec: StepSpec) -> tuple[str, dict[str, str]]:
    """The functions that ``c/lanes.c`` calls, and its words."""
    own, problem = _LaneWriter(spec), spec.problem
    given = {"s->h": problem.h} | ({"s->p": problem.p} if problem.p.numel() else {})
    parts = {name: part.columns(own.used) for name, part in own.parts._asdict().items()}
    numbers = ca.vertcat(*(own.numbers.values or [ca.SX(0)]))
    functions = [
        c_function("lane_parts", given, parts, "z where nothing moves, E and Y there, Y at z = 0: by the columns of maps"),
        c_function("lane_numbers", given, {"numbers": numbers}, "entries of matrices that depend on parameters"),
    ]
    size = own.C * (own.n + 2 * own.m) + numbers.numel() + 2 * problem.state.numel() + 2 * own.m
    replacements = {
        "LANES": str(next((width for most, width in LANE_WIDTHS.items() if size <= most), 8)), "MAP_COLUMNS": str(own.C),
        "MAP_NUMBERS": str(numbers.numel()), "ALIGNMENT": str(ALIGNMENT),
        "BARE": str(len(own.bare)), "BARE_COLUMNS": ", ".join(map(str, own.bare or [0])),
        "ERRORS": _rounding_residual_lines(spec, own.n, own.m),
    }  # fmt: skip
    return "\n".join(functions), replacements | _step_statements(own)


def _step_statements(own: _LaneWriter) -> dict[str, str]:
    """A step, and a step that is looked at."""
    loose, rows = [i for i in range(own.m) if i not in own.exact], list(range(own.m))
    sizes = {"z": own.n, "l": own.m, "E": own.n, "scale": own.n, "y": own.m, "size": own.m}
    store = [f"g->{name}[{i}][j] = {name}_{i};" for name, size in sizes.items() for i in range(size)]
    store += [f"g->wrong[{i}][j] = {own.wrong(i)};" for i in rows]
    inside = [*own.inside(), *(f"r_{own.n + i} <= HOPELESS" for i in rows), "all - all == 0"]
    ahead = [f"next[{i}][j] = next_{i};" for i in range(own.rows["next"].numel())]
    return {
        "STEPS": _indented_lines([*own.body(loose), *ahead, *own.finiteness_lines(loose), *own.residual(loose)]),
        "JUDGED": _indented_lines([*own.body(rows), *ahead, *store, *own.finiteness_lines(rows), *own.residual(rows)]),
        "SETTLED": own.acceptance_condition(),
        "INSIDE": " & ".join(f"({test})" for test in inside),
    }


def _rounding_residual_lines(spec: StepSpec, n: int, m: int) -> str:
    """The residual of (z, l) beside what rounding may do."""
    p, body = spec.problem, _StepStatements()
    known = {"x[{i}][j]": p.state, "g->z[{i}][j]": p.z, "g->l[{i}][j]": p.l, "h": p.h, "g->p[{i}][j]": p.p}
    body.add(
        {key: e for key, e in known.items() if e.numel()}, {"e": rounding_error_bound(ca.vertcat(p.E, p.Y), ca.vertcat(p.z, p.l))}
    )
    parts = [f"part_of(fabs(g->E[{i}][j]), g->scale[{i}][j] + unseen(e_{i}))" for i in range(n)]
    parts += [f"part_of(g->wrong[{i}][j], g->size[{i}][j] + unseen(e_{n + i}))" for i in range(m)]
    return _indented_lines([*body.lines, *_maximum_lines(parts)])
