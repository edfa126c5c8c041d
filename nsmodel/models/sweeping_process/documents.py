"""Certificates of sweeping processes: the constraints with the U_i of A0 to A4, and what shows their forms.

The class in LaTeX.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Any

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
    convexity_hint,
    exact_matrix_text,
    exact_number_text,
    straight_line_program,
)
from nsmodel.hypotheses.certificates.write import CertificateSubject, Data, column_text, expression_program
from nsmodel.hypotheses.equations import (
    constraint_lines,
    function_call_latex,
    space_latex,
    start_line,
    state_lines,
    symbol_names,
    vector_lines,
)
from nsmodel.hypotheses.findings import Finding
from nsmodel.models.sweeping_process.constraint_shapes import AffineForm, ConstraintShape, read_shapes
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


def subject(model: SweepingProcess, findings: Mapping[str, Finding]) -> CertificateSubject:
    """The model as data."""
    shapes = read_shapes(model.g, model.q) if model.multiplier_names else []
    own = [list(shape.own) for shape in shapes]
    c, b = (findings[id].value.get(name, 1.0) if id in findings else 1.0 for id, name in (("A0", "c"), ("A1", "b")))
    on_box = Fraction(c) * Fraction(b) if np.isfinite([c, b]).all() else Fraction(1)
    deltas = [
        {}
        if shape.kind == "plane"
        else {"delta": exact_number_text(radius_lower_bound(shape, model) / 2 if shape.kind == "distance" else on_box)}
        for shape in shapes
    ]
    rows = zip(model.multiplier_names, ca.vertsplit(model.g), own, deltas, strict=True) if own else []
    data = {
        "constraints": [
            {
                "name": name,
                "graph": expression_program(g, ca.vertcat(model.t, model.q[own]), ["t", *(model.names[i] for i in own)]),
            } | delta
            for name, g, own, delta in rows
        ],
        "f": expression_program(model.f, ca.vertcat(model.t, model.q), ["t", *(model.names or ())]),
        "q0": column_text(model.q0),
    }  # fmt: skip
    return CertificateSubject(model, data)


def radius_lower_bound(shape: ConstraintShape, model: SweepingProcess) -> Fraction:
    """Of a distance less r(t) a number that r is not below, at all times; U_i = {g_i > -delta} with half of it."""
    offset = shape.written.affine.offset
    if isinstance(offset, Fraction):
        return -offset
    top = extremum.supremum(offset, model.t, np.zeros(1), np.array([float(model.t_end or 0.0)])).bound
    return Fraction(-top) * (1 - Fraction(1, 2**40)) if top < 0 else Fraction(0)


def proofs(
    model: SweepingProcess, data: Data, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: the form of each constraint, covers of the box, directions of escape."""
    return [_sweeping_hint(model, data, finding, findings, room)]


def _sweeping_hint(model: SweepingProcess, data: Data, finding: Finding, findings: Mapping[str, Finding], room: Fraction) -> Any:
    if finding.id == "S-f":
        straight_line_program(model.f, ca.vertcat(model.t, model.q), ["t", *(model.names or ())])  # it may not be written
    if finding.id in ("S-f", "S-start"):
        return {"time": AdaptiveCover(), "cover": AdaptiveCover()}
    if finding.id in ("A5", "A5'"):
        return {"cover": AdaptiveCover(_escape_direction_rule(model))}
    shapes = read_shapes(model.g, model.q) if model.multiplier_names else []
    return {
        "constraints": [_constraint_form_hint(model, data, k, shape, finding, findings, room) for k, shape in enumerate(shapes)]
    }


def _constraint_form_hint(
    model: SweepingProcess, data: Data, k: int, shape: Any, finding: Finding, findings: Mapping[str, Finding], room: Fraction
) -> dict[str, Any]:
    """The form of one constraint: affine, a norm or the distance to a segment, else bounds over the box."""
    if shape.kind == "plane":
        rules = finding.id == "S-convex"
        return {"form": "rules", "time": AdaptiveCover()} if rules else {"form": "box", "cover": AdaptiveCover(only=[0])}
    if shape.kind == "distance":
        hint = _norm_form_hint(model, shape)
        if hint is not None:
            return hint
    local = finding.scope is not None and bool(finding.scope.states)
    if finding.id == "S-convex":
        program, atoms = verify.VerifierProgram(data["constraints"][k]["graph"]), verify.Atoms()
        (p,) = atoms.read(program)
        hint = convexity_hint(p, range(1, len(program.inputs)), atoms)
        return hint | ({"form": "box"} if "cover" in hint else {"form": "rules", "time": AdaptiveCover()})
    if not local and finding.id not in ("A2", "A3", "A4"):
        raise UnprovedFinding(f"constraint '{model.multiplier_names[k]}': a form that is not written down here")
    b = finding.value.get("b") if finding.id == "A1" else findings["A1"].value.get("b") if "A1" in findings else None
    if finding.id not in ("A0", "A1"):
        b = np.inf
    if b is None:
        raise UnprovedFinding("no bound of the gradients is known")
    bound = {"b": exact_number_text(Fraction(b) * (1 + room / 2))} if np.isfinite(b) else {}
    return {"form": "box", "cover": AdaptiveCover(), **bound}


def _norm_form_hint(model: SweepingProcess, shape: Any) -> dict[str, Any] | None:
    """w |A q + c(t)| + offset(t), or the distance to a segment."""
    (weight, squares), offset = shape.written.norms[0], shape.written.affine.offset
    if any(w != 1 for w, _ in squares):
        return None
    place = {i: j for j, i in enumerate(shape.own)}
    A = exact.zeros(len(squares), len(place))
    for row, (_, a) in enumerate(squares):
        for i, number in a.row.items():
            if i >= 0:
                A[row, place[i]] = number
    hint: dict[str, Any] = {"form": "norm", "w": exact_number_text(weight), "A": exact_matrix_text(A), "time": AdaptiveCover(),
                            "c": [_time_graph(a, model) for _, a in squares], "offset": _time_graph(offset, model)}  # fmt: skip
    if shape.clips:
        if any(a.row.get(i) != -1 for _, a in squares for i in a.row if i < 0):
            raise UnprovedFinding("the distance to a segment that is aslant: its projection is one up to rounding only")
        clips = [next((shape.clips[i] for i in a.row if i < 0), None) for _, a in squares]
        if any(clip is not None and None in (clip.low, clip.high) for clip in clips):
            raise UnprovedFinding("the distance to a half-line")
        hint["clips"] = [clip and [exact_number_text(clip.low), exact_number_text(clip.high)] for clip in clips]
    gram = exact.doubles(exact.matrix_product(A, A.T))
    b = Fraction(float(weight) * float(np.sqrt(np.linalg.eigvalsh(gram)[-1]))) * (1 + ROUNDING_ALLOWANCE / 4)
    return hint | {"reach": exact_number_text(radius_lower_bound(shape, model)), "b": exact_number_text(b)}


def _time_graph(a: AffineForm | Any, model: SweepingProcess) -> Any:
    offset = a.offset if isinstance(a, AffineForm) else a
    if isinstance(offset, Fraction):
        return {"inputs": ["t"], "steps": [["const", exact_number_text(offset)]], "outputs": [0]}
    return straight_line_program(offset, model.t, ["t"])


def _escape_direction_rule(model: SweepingProcess) -> Callable[[list[Any]], Any]:
    """A direction of escape for the constraints near the middle of a part."""
    slopes = ca.Function("slopes", [model.t, model.q], [ca.densify(ca.jacobian(model.g, model.q)), ca.densify(model.g)])

    def direction(box: list[Any]) -> Any:
        middle = np.array([float(x.lo + x.hi) / 2 for x in box])
        reach = np.linalg.norm([float(x.hi - x.lo) for x in box])
        G, g = (np.array(item) for item in slopes(middle[0], middle[1:]))
        size = np.linalg.norm(G, axis=1)
        near = np.flatnonzero((g.ravel() <= reach * np.maximum(size, 1e-300)) & (size > 0))
        if len(near) < 2 or not np.isfinite(G[near]).all():
            return [
                exact_number_text(x)
                for x in (G[near[0]] if len(near) and np.isfinite(G[near[0]]).all() else np.ones(len(middle) - 1))
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
