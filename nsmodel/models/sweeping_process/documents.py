"""Certificates of sweeping processes: the constraints with the U_i of A0 to A4, and what shows their forms.

The class in LaTeX.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from types import MappingProxyType
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.hints import (
    KEEP_EXACT,
    ROUND_DOWN,
    ROUNDING_ALLOWANCE,
    AdaptiveCover,
    StatedNumber,
    UnprovedFinding,
    UnsupportedOperation,
    convexity_hint,
    exact_matrix_text,
    exact_number_text,
    straight_line_program,
)
from nsmodel.hypotheses.certificates.write import CertificateParts, CertificateSubject, Data, column_text, expression_program
from nsmodel.hypotheses.equations import (
    constraint_lines,
    function_call_latex,
    space_latex,
    start_line,
    state_lines,
    symbol_names,
    vector_lines,
)
from nsmodel.hypotheses.findings import Finding, IntervalBox
from nsmodel.models.sweeping_process.constraint_shapes import ConstraintShape, read_shapes
from nsmodel.models.sweeping_process.mfcq_constant import mfcq_constant
from nsmodel.models.sweeping_process.model import SweepingProcess
from nsmodel.proof import exact, extremum

STATED = {
    "A0": (StatedNumber("c", ROUND_DOWN),), "A1": (StatedNumber("a", ROUND_DOWN), StatedNumber("b")),
    "A2": (StatedNumber("b", name="speed"),),
    "A3": (StatedNumber("M", name="turn"),), "A4": (StatedNumber("M"), StatedNumber("M_contact")),
    "A5": (StatedNumber("gamma"), StatedNumber("rho", KEEP_EXACT)), "A5'": (StatedNumber("gamma"),),
    "S-f": (StatedNumber("K_f"), StatedNumber("L_f"), StatedNumber("L_t")),
}  # fmt: skip


class ConstraintRow(NamedTuple):
    """One constraint, or a family of them.

    Attributes:
        name, g: its name, and the expression of q, of ``slow`` and of the symbols that are known exactly.
        q, names: its states.
        slow, slow_names: time, numbers in which the members of a family differ, and parameters.
        lower, upper: between which ends these lie.
        exact: {symbol: number} of the symbols that are known exactly.
        members: of a family the states and the numbers of each constraint.
    """

    name: str
    g: ca.SX
    q: ca.SX
    names: Sequence[str]
    slow: ca.SX
    slow_names: Sequence[str]
    lower: np.ndarray
    upper: np.ndarray
    exact: Mapping[ca.SX, float] = MappingProxyType({})
    members: Sequence[tuple[Sequence[str], Sequence[float]]] | None = None

    @property
    def shape(self) -> ConstraintShape:
        """What g is made of, up to the rounding of constants."""
        g = ca.substitute(self.g, ca.vertcat(ca.SX(0, 1), *self.exact), ca.SX(ca.DM([*self.exact.values()])))
        return read_shapes(g, self.q)[0]

    def program(self, expr: ca.SX, states: bool = True) -> Data:
        """A function of time, where asked for of the states, and of the rest."""
        q, names = (self.q, self.names) if states else (ca.SX(0, 1), ())
        inputs = ca.vertcat(self.slow[0], q, self.slow[1:, :])
        return straight_line_program(expr, inputs, ["t", *names, *self.slow_names[1:]], self.exact)

    def constant(self, number: Fraction) -> Data:
        """A number as a function of time and the rest."""
        return {"inputs": ["t", *self.slow_names[1:]], "steps": [["const", str(number)]], "outputs": [0]}

    def parameters(self, subject: CertificateSubject) -> verify.Parameters:
        """What ``verify`` proves the function for all values of."""
        count, ends = len(subject.ranges), zip(self.lower.tolist(), self.upper.tolist(), strict=True)
        numbers = [
            verify.between(count + k, Fraction(a), Fraction(b))
            for k, (a, b) in enumerate(list(ends)[1 : len(self.slow_names) - count])
        ]
        return dict(zip(self.slow_names[1:], numbers, strict=False)) | subject.parameters


def subject(model: SweepingProcess, findings: Mapping[str, Finding], ranges: IntervalBox) -> CertificateSubject:
    """The model as data."""
    f = expression_program(model, model.f, ca.vertcat(model.t, model.q), ["t", *(model.names or ())])
    data = {"constraints": rows_data(constraint_rows(model, ranges), findings), "f": f, "q0": column_text(model, model.q0)}
    return CertificateSubject(model, data, ranges=ranges)


def constraint_rows(model: SweepingProcess, ranges: IntervalBox) -> list[ConstraintRow]:
    """The constraints one by one."""
    slow, names, ends = slow_inputs(model, ranges)
    shapes = read_shapes(model.g, model.q) if model.multiplier_names else []
    rows = zip(model.multiplier_names, ca.vertsplit(model.g), shapes, strict=True) if shapes else ()
    return [
        ConstraintRow(name, g, model.q[list(shape.own)], [model.names[i] for i in shape.own], slow, names, *ends)
        for name, g, shape in rows
    ]


def slow_inputs(model: Any, ranges: IntervalBox) -> tuple[ca.SX, list[str], np.ndarray]:
    """Time and the parameters, their names and ends."""
    ends = np.array([(0.0, float(model.t_end or 0.0)), *ranges.values()]).T
    return ca.vertcat(model.t, model.p), ["t", *ranges], ends


def rows_data(rows: Sequence[ConstraintRow], findings: Mapping[str, Finding]) -> list[Data]:
    """The constraints as data, with the U_i of A0 to A4."""
    c, b = (findings[id].value.get(name, 1.0) if id in findings else 1.0 for id, name in (("A0", "c"), ("A1", "b")))
    on_box = Fraction(c) * Fraction(b) if np.isfinite([c, b]).all() else Fraction(1)
    found = []
    for row in rows:
        shape = row.shape
        try:
            graph = row.program(row.g)
        except UnsupportedOperation as why:
            graph = {"inputs": ["t", *row.names, *row.slow_names[1:]], "why": str(why)}
        data: Data = {"name": row.name, "graph": graph}
        if shape.kind != "plane":
            delta = radius_lower_bound(row, shape) / 2 if shape.kind == "distance" else on_box
            data["delta"] = exact_number_text(delta)
        if row.members is not None:
            data["numbers"] = list(row.slow_names[1 : 1 + len(row.members[0][1])])
            data["members"] = [
                {"states": list(names), "numbers": [exact_number_text(x) for x in numbers]} for names, numbers in row.members
            ]
        found.append(data)
    return found


def radius_lower_bound(row: ConstraintRow, shape: ConstraintShape) -> Fraction:
    """Of a distance less r(t) a number that r is not below, at all times; U_i = {g_i > -delta} with half of it."""
    offset = shape.written.affine.offset
    if isinstance(offset, Fraction):
        return -offset
    top = extremum.supremum(offset, row.slow, row.lower, row.upper).bound
    return Fraction(-top) * (1 - Fraction(1, 2**40)) if top < 0 else Fraction(0)


def proofs(
    subject: CertificateSubject, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: the form of each constraint, covers of the box, directions of escape."""
    model: SweepingProcess = subject.model
    if finding.id in ("S-f", "S-start"):
        if finding.id == "S-f":
            verify.VerifierProgram(subject.data["f"], None, None, subject.parameters)  # it may not be written down
            return [{"time": AdaptiveCover()}, {"cover": AdaptiveCover()}]
        return [{}]
    if finding.id in ("A5", "A5'"):
        every = finding.id == "A5" and "rho" not in value
        return [{"cover": AdaptiveCover(_escape_direction_rule(model, np.inf if every else 0.0))}]
    return [constraint_hints(subject, constraint_rows(model, subject.ranges), finding)]


def constraint_hints(subject: CertificateSubject, rows: Sequence[ConstraintRow], finding: Finding) -> Data:
    """The form of each constraint."""
    return {"constraints": [_constraint_form_hint(subject, row, k, finding) for k, row in enumerate(rows)]}


def _constraint_form_hint(subject: CertificateSubject, row: ConstraintRow, k: int, finding: Finding) -> dict[str, Any]:
    """The form of one constraint: affine, a norm or the distance to a box or a segment, else bounds over the box."""
    shape = row.shape
    if shape.kind == "plane":
        n = row.q.numel()
        slow = [0, *range(1 + n, n + row.slow.numel())]
        return {"time": AdaptiveCover()} if finding.id == "S-convex" else {"cover": AdaptiveCover(only=slow)}
    if shape.kind == "distance" and (hint := _norm_form_hint(subject, row, shape, k)) is not None:
        return hint
    if finding.id == "S-convex":
        program, atoms = (
            verify.VerifierProgram(subject.data["constraints"][k]["graph"], None, None, row.parameters(subject)),
            verify.Atoms(),
        )
        (p,) = atoms.read(program)
        return {"time": AdaptiveCover()} | convexity_hint(p, range(1, program.n), atoms)
    local = finding.scope is not None and bool(finding.scope.states)
    if not local and finding.id not in ("A2", "A3", "A4"):
        raise UnprovedFinding(f"constraint '{row.name}': a form that is not written down here")
    return {"cover": AdaptiveCover()}


def _norm_form_hint(subject: CertificateSubject, row: ConstraintRow, shape: ConstraintShape, k: int) -> dict[str, Any] | None:
    """w |A q + c(t)| + offset(t), or the distance to a segment or a box; None where it is written in another way."""
    (weight, squares), offset = shape.written.norms[0], shape.written.affine.offset
    hint: dict[str, Any] = {
        "form": "norm", "w": exact_number_text(weight), "time": AdaptiveCover(), "offset": _time_graph(offset, row),
        "reach": exact_number_text(radius_lower_bound(row, shape)),
    }  # fmt: skip
    if len(shape.clips) == 1:
        program = verify.VerifierProgram(subject.data["constraints"][k]["graph"], None, None, row.parameters(subject))
        n = row.q.numel()
        hint |= {"A": exact_matrix_text(exact.eye(n)), "b": exact_number_text(weight)}
        for line in segment_hints(program):
            if _is_norm_form(program, found := hint | line):
                return found
        return None
    if any(w != 1 for w, _ in squares):
        return None
    place = {i: j for j, i in enumerate(shape.own)}
    A = exact.zeros(len(squares), len(place))
    for one, (_, a) in enumerate(squares):
        for i, number in a.row.items():
            if i >= 0:
                A[one, place[i]] = number
    hint |= {"A": exact_matrix_text(A), "c": [_time_graph(a.offset, row) for _, a in squares]}
    if shape.clips:
        clips = [next((shape.clips[i] for i in a.row if i < 0), None) for _, a in squares]
        directions = zip(exact_matrix_text(exact.eye(len(squares))), clips, strict=True)
        hint["clips"] = [[e, _clip_ends(clip)] for e, clip in directions if clip is not None]
    gram = exact.doubles(exact.matrix_product(A, A.T))
    b = Fraction(float(weight) * float(np.sqrt(np.linalg.eigvalsh(gram)[-1]))) * (1 + ROUNDING_ALLOWANCE / 4)
    return hint | {"b": exact_number_text(b)}


def _clip_ends(clip: Any) -> list[str]:
    return [exact_number_text(end if end is not None else none) for end, none in ((clip.low, -np.inf), (clip.high, np.inf))]


def _is_norm_form(program: verify.VerifierProgram, hint: dict[str, Any]) -> bool:
    try:
        verify.NormForm(program, hint)
    except verify.Unproved:
        return False
    return True


def segment_hints(g: verify.VerifierProgram) -> Iterator[dict[str, Any]]:
    """What a norm of q - a - s e, s the nearest point to <q - a, e>/|e|^2 of an interval, may be: a as c, e and the interval."""
    atoms, own = verify.Atoms(), range(1, g.n)
    (p,) = atoms.read(g)
    meanings = [atoms.meaning[v] for m in p for v, _ in m if v in atoms.meaning and len(atoms.meaning[v]) > 2]
    inner = next((u if op == "pow" else u * u for op, u, w in meanings if op == "pow" or (op == "fmax" and w == -u)), None)
    if inner is None:
        return
    c = [-inner.get(((v, 1),), Fraction(0)) / -2 for v in own]
    for v in sorted({v for m in inner for v, _ in m if v in atoms.meaning}):
        op, u, w = atoms.meaning[v] if atoms.meaning[v][0] == "fmax" else ("", verify.Poly({}), verify.Poly({}))
        x, end = (u, w.number()) if w.number() is not None else (w, u.number())
        nested = [atoms.meaning[k] for m in x for k, _ in m if k in atoms.meaning]
        tries: list[tuple[verify.Poly, list[Any]]] = [(x, [end, "inf"]), (-x, ["-inf", None if end is None else -end])]
        for _, y, z in (part for part in nested if part[0] == "fmax"):
            y, other = (y, z.number()) if z.number() is not None else (z, y.number())
            if end is not None and other is not None:
                tries += [(y, [other, -end]), (-y, [-other, end])]
        for line, ends in tries if op and end is not None else ():
            slope = [line.get(((k, 1),), Fraction(0)) for k in own]
            size = sum(a * a for a in slope)
            if size:
                const = [{"inputs": ["t", *g.inputs[g.n :]], "steps": [["const", str(entry)]], "outputs": [0]} for entry in c]
                yield {"c": const, "clips": [[[str(a / size) for a in slope], [str(end) for end in ends]]]}


def _time_graph(offset: Any, row: ConstraintRow) -> Any:
    return row.constant(offset) if isinstance(offset, Fraction) else row.program(offset, states=False)


def _escape_direction_rule(model: SweepingProcess, rho: float) -> Callable[[list[Any]], Any]:
    """A direction of escape for the constraints near the middle of a part, or within rho."""
    z = ca.vertcat(model.t, model.q, model.p)
    slopes = ca.Function("slopes", [z], [ca.densify(ca.jacobian(model.g, model.q)), ca.densify(model.g)])

    def direction(box: list[Any]) -> Any:
        middle = np.array([float(x.lo + x.hi) / 2 for x in box])
        reach = np.linalg.norm([float(x.hi - x.lo) for x in box])
        G, g = (np.array(item) for item in slopes(middle))
        size = np.linalg.norm(G, axis=1)
        near = np.flatnonzero((g.ravel() <= rho + reach * np.maximum(size, 1e-300)) & (size > 0))
        if len(near) < 2 or not np.isfinite(G[near]).all():
            return [
                exact_number_text(x)
                for x in (G[near[0]] if len(near) and np.isfinite(G[near[0]]).all() else np.ones(model.q.numel()))
            ]
        normals = G[near] / size[near, None]
        return [exact_number_text(x) for x in mfcq_constant(normals)[1] @ normals]

    return direction


def equations(model: SweepingProcess) -> list[str]:
    """The model, one formula a line."""
    names = symbol_names(model)
    t = "t" if ca.depends_on(model.g, model.t) else ""
    Q, f = "Q(t)" if t else "Q", "" if model.f.is_zero() else function_call_latex("f", model.f, model, names, "q")
    p = model.g.numel()
    lines = [rf"\dot{{q}} + N_{{{Q}}}(q) \ni {f or '0'}", *state_lines(model)]
    if f:
        lines += vector_lines(f, model.f, names)
    g = "g_i(t, q)" if t else "g_i(q)"
    rows = rf"{g} \geq 0,\ i = 1, \ldots, {p}" if p != 1 else rf"{g.replace('_i', '')} \geq 0"
    lines.append(
        rf"{Q} = \left\{{ q \in {space_latex(len(model.names))} : {rows} \right\}}"
        if p
        else f"Q = {space_latex(len(model.names))}"
    )
    return [*lines, *constraint_lines("g", model.constraints, model, names, "q"), start_line("q(0)", model.q0, names)]


CERTIFICATE = CertificateParts(stated=STATED, subject=subject, proofs=proofs)
