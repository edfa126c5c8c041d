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
    UnsupportedOperation,
    convexity_hint,
    cover_hint,
    interior_point_hint,
    nonnegativity_hint,
)
from nsmodel.hypotheses.certificates.write import CertificateParts, CertificateSubject, Data, column_text, expression_program
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
from nsmodel.modeling.parameters import time_as_parameter
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
    operator = ca.substitute(model.operator, model.sign_symbols, ca.SX.zeros(model.sign_symbols.numel()))
    S = None if model.phi is not None or operator.is_zero() else expression_program(model, operator, model.x, model.names)
    data = {"F": expression_program(model, model.field, model.x, model.names), "S": S, "phi": _potential(model, ranges),
            "C": expression_program(model, rows, model.x, model.names), "x0": column_text(model, model.x0)}  # fmt: skip
    return CertificateSubject(model, data, ranges=ranges)


def _potential(model: MonotoneInclusion, ranges: IntervalBox) -> Data | None:
    """The program of phi; of switches, which add Sgn(a'x + c) times w a, of the sum of w |a'x + c|. None where there is neither.

    It is not written down where the weights of a switch are not along the slope a of its argument.
    """
    if model.phi is not None:
        return expression_program(model, potential_without_domain(model.phi, model.x, "phi"), model.x, model.names)
    if not model.sign_symbols.numel():
        return None
    weights = ca.densify(ca.jacobian(model.operator, model.sign_symbols))
    slopes = ca.densify(ca.jacobian(model.sign_arguments, model.x).T)
    phi, values = ca.SX(0), {}

    def quotient_term(entry: ca.SX) -> ca.SX:
        """An entry; a number as a symbol, as CasADi would round quotients of numbers."""
        if ca.symvar(entry):
            return entry
        symbol = ca.SX.sym("number")
        values[symbol] = float(entry)
        return symbol

    for k, argument in enumerate(ca.vertsplit(model.sign_arguments)):
        a, w = slopes[:, k], weights[:, k]
        i = next((i for i in range(a.numel()) if not a[i].is_zero()), 0)
        if not _is_along(model, w, a, i, ranges):
            names = expression_program(model, model.x, model.x, model.names or ())["inputs"]
            return {"inputs": names, "why": "switches whose sum is no subdifferential"}
        phi += quotient_term(w[i]) / quotient_term(a[i]) * ca.fabs(argument)
    return expression_program(model, phi, model.x, model.names or (), values)


def _is_along(model: MonotoneInclusion, w: ca.SX, a: ca.SX, i: int, ranges: IntervalBox) -> bool:
    """Whether w is a multiple of a, exactly, and entry i of a is not 0."""
    parameters = CertificateSubject(model, {}, ranges=ranges).parameters
    try:
        w_exact, a_exact = ([verify.number(text, parameters=parameters) for text in column_text(model, part)] for part in (w, a))
    except (verify.Unproved, UnsupportedOperation):
        return False
    left = (one * a_exact[i] + w_exact[i] * -other + verify.constant(0) for one, other in zip(w_exact, a_exact, strict=True))
    return bool(a_exact[i]) and not any(left)


def proofs(
    subject: CertificateSubject, finding: Finding, findings: Mapping[str, Finding], value: dict[str, str], room: Fraction
) -> list[Any]:
    """Hints: a point inside C, convexity, squares, covers."""
    model: MonotoneInclusion = subject.model
    if finding.id == "M-C":
        return [interior_point_hint(subject, finding)]
    if finding.id == "M-A2":
        return [{}]
    atoms, read = verify.Atoms(), verify.InclusionData(subject.data, subject.parameters)
    if finding.id == "M-A3":
        found = nonnegativity_hint(read.dissipation({name: Fraction(number) for name, number in value.items()}, atoms), atoms)
        if found is None:
            raise UnprovedFinding("the dissipation is not shown to be >= 0 by squares")
        return [found]
    if finding.id == "M-A1":
        return [{"cover": AdaptiveCover()}]
    potential = read.where_given("phi", 1)
    phi = {} if potential is None else {"phi": convexity_hint(atoms.read(potential)[0], range(read.n), atoms)}
    if finding.id == "M-T":
        return [cover_hint(model.operator, model.x) | phi]
    slope = 0 if model.phi is None else ca.gradient(potential_without_domain(model.phi, model.x, "phi"), model.x)
    return [cover_hint(model.field - model.operator - slope, model.x) | phi]


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


CERTIFICATE = CertificateParts(stated=STATED, subject=subject, proofs=proofs)
