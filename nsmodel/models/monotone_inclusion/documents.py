"""Certificates of inclusions: F, S or Phi, C; covers and squares.

The class in LaTeX.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import casadi as ca

from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.hints import (
    ROUND_DOWN,
    AdaptiveCover,
    StatedNumber,
    UnprovedFinding,
    convexity_hint,
    cover_hint,
    interior_point_hint,
    nonnegativity_hint,
)
from nsmodel.hypotheses.certificates.write import CertificateSubject, column_text, expression_program
from nsmodel.hypotheses.equations import (
    MAX_LISTED_ROWS,
    constraint_lines,
    entry_formulas,
    function_call_latex,
    start_line,
    state_lines,
    symbol_names,
    vector_lines,
)
from nsmodel.hypotheses.findings import Finding, IntervalBox
from nsmodel.hypotheses.latex import SymbolNames
from nsmodel.hypotheses.region import potential_without_domain
from nsmodel.modeling.convex_split import ConvexSplit
from nsmodel.models.monotone_inclusion.check import time_as_parameter
from nsmodel.models.monotone_inclusion.model import MonotoneInclusion
from nsmodel.models.monotone_inclusion.schemes import set_constraints
from nsmodel.proof.expression_graph import stack_column

STATED = {
    "M-A2": (StatedNumber("a_1"), StatedNumber("a_2")), "M-A3": (StatedNumber("alpha", ROUND_DOWN), StatedNumber("beta")),
    "M-24": (StatedNumber("L"),),
}  # fmt: skip


def subject(model: MonotoneInclusion, findings: Mapping[str, Finding], ranges: IntervalBox) -> CertificateSubject:
    """The model as data; time, where something depends on it, is one of the parameters."""
    times = [finding.scope.time for finding in findings.values() if finding.scope is not None and finding.scope.time is not None]
    if model.moves and times:
        model, ranges = time_as_parameter(model), {**ranges, str(model.t): times[0]}
    rows, _ = set_constraints(model)
    phi = (
        None
        if model.phi is None
        else expression_program(model, potential_without_domain(model.phi, model.x, "phi"), model.x, model.names)
    )
    signs, sizes = model.sign_symbols, ca.jacobian(model.operator, model.sign_symbols)
    operator = ca.substitute(model.operator, signs, ca.SX.zeros(signs.numel()))
    S = None if model.phi is not None or operator.is_zero() else expression_program(model, operator, model.x, model.names)
    switches = [
        [column_text(model, sizes[:, k]), expression_program(model, argument, model.x, model.names)]
        for k, argument in enumerate(ca.vertsplit(model.sign_arguments)) if signs.numel()
    ]  # fmt: skip
    data = {"F": expression_program(model, model.field, model.x, model.names), "phi": phi, "S": S,
            "C": expression_program(model, rows, model.x, model.names), "x0": column_text(model, model.x0),
            "switches": switches}  # fmt: skip
    return CertificateSubject(model, data, ranges=ranges)


def proofs(
    subject: CertificateSubject, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: a point inside C, convexity, squares, covers."""
    model: MonotoneInclusion = subject.model
    if finding.id == "M-C":
        return [interior_point_hint(subject, finding)]
    V = model.field - (
        model.operator if model.phi is None else ca.gradient(potential_without_domain(model.phi, model.x, "phi"), model.x)
    )
    if finding.id == "M-T":
        if model.phi is None:
            return [cover_hint(model.operator, model.x)]
        atoms = verify.Atoms()
        (phi,) = atoms.read(verify.VerifierProgram(subject.data["phi"], None, None, subject.parameters))
        return [convexity_hint(phi, range(model.x.numel()), atoms)]
    if finding.id == "M-A2":
        return [{}]
    if finding.id == "M-A3":
        atoms, numbers = verify.Atoms(), {name: Fraction(number) for name, number in value.items()}
        read = verify.InclusionData(subject.data, subject.parameters)
        found = nonnegativity_hint(verify.dissipation(read, numbers, atoms), atoms)
        if found is None:
            raise UnprovedFinding("the dissipation is not shown to be >= 0 by squares")
        return [found]
    return [cover_hint(V, model.x) if finding.id == "M-24" else {"cover": AdaptiveCover()}]


LATEX_SEPARATOR = r",\ "


def equations(model: MonotoneInclusion) -> list[str]:
    """The model, one formula a line."""
    names = symbol_names(model)
    potential = model.potential_split
    single = potential is None and model.operator.is_zero()
    bounds = [entry_formulas(side, names) for side in (model.lower, model.upper)]
    box = set(bounds[0]) != {r"-\infty"} or set(bounds[1]) != {r"\infty"}
    F, jumps = function_call_latex("F", model.field, model, names, "x"), ca.vertcat(model.operator, model.sign_arguments)
    Sx = function_call_latex("S", jumps, model, names, "x")
    sides_of_C = ca.vertcat(model.lower, model.upper, *model.constraints.values())
    C = function_call_latex("C", sides_of_C, model, names) if box or model.constraints else ""
    S, N = ("" if single else f" - {Sx}"), (rf" - N_{{{C}}}(x)" if C else "")
    first = rf"\dot{{x}} \in {F}{S}{N}" if S or N else rf"\dot{{x}} = {F}"
    lines = [first, *state_lines(model), *vector_lines(F, model.field, names)]
    if potential is not None:
        lines.append(rf"S = \partial\Phi,\quad \Phi(x) = {entry_formulas(_joined_potential(potential), names)[0]}")
    elif not single:
        sign_texts = [rf"\mathrm{{Sgn}}\left({text}\right)" for text in entry_formulas(model.sign_arguments, names)]
        symbols = [str(symbol) for symbol in ca.vertsplit(model.sign_symbols)] if sign_texts else []
        marked = SymbolNames({**names.latex, **dict(zip(symbols, sign_texts, strict=True))}, names.vectors)
        lines += vector_lines(Sx, model.operator, marked)
    if N:
        sides = [_box_latex(*bounds)] if box else []
        sides += [r"c_i(x) \geq 0,\ i = 1, \ldots, " + str(len(model.constraint_names))] if model.constraints else []
        lines.append(rf"{C} = \left\{{ x : {LATEX_SEPARATOR.join(sides)} \right\}}")
    return [*lines, *constraint_lines("c", model.constraints, model, names, "x"), start_line("x(0)", model.x0, names)]


def _box_latex(lower: Sequence[str], upper: Sequence[str]) -> str:
    """The conditions lower <= x <= upper, once where all components have the same."""
    pairs = list(zip(lower, upper, strict=True))
    if len(set(pairs)) == 1:
        return _bounds_latex(*pairs[0], "x" if len(pairs) == 1 else "x_i")
    rows = [_bounds_latex(a, b, f"x_{{{i}}}") for i, (a, b) in enumerate(pairs)]
    kept = [row for row in rows if row]
    return LATEX_SEPARATOR.join(kept if len(kept) <= MAX_LISTED_ROWS else [*kept[:MAX_LISTED_ROWS], r"\ldots"])


def _bounds_latex(low: str, high: str, name: str) -> str:
    if low == r"-\infty":
        return rf"{name} \leq {high}" if high != r"\infty" else ""
    return rf"{low} \leq {name} \leq {high}" if high != r"\infty" else rf"{name} \geq {low}"


def _joined_potential(split: ConvexSplit) -> ca.SX:
    """The potential put together again, without the indicators of its domain."""
    shape = {"abs": ca.fabs, "max": lambda u: ca.fmax(u, 0), "norm": ca.norm_2}
    terms = [term.weight * shape[term.kind](term.u) for term in split.terms if term.kind in shape]
    return split.smooth + ca.sum1(stack_column(terms))
