"""Signs of functions of one variable built from polynomials, roots, powers and exponentials, on a whole interval.

A function is kept as a quotient N / (D_1 D_2 ...) of sums of terms R(s) E(s), R rational and E = prod u_j(s)^p_j e^(q(s)) > 0
with polynomials u_j > 0 and q. The sign of one term is that of R, which is decided exactly. A sum of m terms is divided by the E of
one of them and differentiated until that term, a polynomial by then, is gone: m - 1 terms are left, whose signs are known by
induction. Going back, each function is monotone between the places where its derivative changes its sign (Rolle), so that its
own changes are found from its signs there, in balls (Arb), and from its leading terms at the two ends of the interval.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca

from nsmodel.proof import polynomial_signs
from nsmodel.proof.graph import fold

MOST_TERMS, MOST_DERIVATIVES, MOST_DEGREE = 12, 60, 80
BISECTIONS, PRECISION = 160, 320
Key = tuple[tuple[tuple[tuple[Fraction, ...], Fraction], ...], tuple[Fraction, ...]]  # ((u, p), ...), 0 < p < 1; q
Sum = dict[Key, tuple[Any, Any]]  # R = numerator / denominator, polynomials of FLINT
Place = tuple[Fraction, Fraction]
Rank = tuple[int, tuple[Fraction, ...]]  # orders exponentials e^q by their size at infinity; q from its highest power down
Cases = dict[int, tuple[tuple[int, ...], Fraction]]  # number of an operation in the graph: factors of its arguments, offset
ONE: Key = ((), ())


class Undecided(Exception):
    """The sign is not found this way."""


class Line(NamedTuple):
    """The open interval (low, high); high None: infinite."""

    low: Fraction
    high: Fraction | None = None


class Quotient(NamedTuple):
    """N over the product of sums, each of them > 0 on the line, to powers: {name: (sum, power)}."""

    top: Sum
    bottom: dict[Any, tuple[Sum, int]]


class Signs(NamedTuple):
    """A function changes its sign in each of the ``places`` (enclosures, in order) and has ``signs`` between them."""

    places: list[Place]
    signs: list[int]


def signs(expr: ca.SX, s: ca.SX, low: Fraction = Fraction(0), high: Fraction | None = None) -> Signs | None:
    """Return the signs of a scalar on the open interval (low, high), None where they are not decided.

    >>> s = ca.SX.sym("s")
    >>> signs(ca.exp(s) - s - 1, s).signs, signs(s * ca.tanh(s) - s / 2, s).signs
    ([1], [-1, 1])
    """
    return _decided(lambda line: _read(expr, s, line, {}).value, Line(low, high))


def second_signs(
    terms: Sequence[tuple[Fraction, ca.SX]],
    s: ca.SX,
    low: Fraction,
    high: Fraction | None,
    cases: Sequence[Cases],
    less: Fraction,
) -> Signs | None:
    """Return the signs of f'' - ``less`` for a sum f of factors times terms, None where they are not decided.

    Each fabs, fmax, fmin and condition is replaced by its case on the interval, which ``cases`` holds for each term.
    """

    def total(line: Line) -> Quotient | None:
        out = Quotient(_constant(-less), {})
        for (factor, term), own in zip(terms, cases, strict=True):
            part = _read(term, s, line, own).second
            if part is None:
                return None
            out = _plus(out, _scaled(part, factor), 1)
        return out

    return _decided(total, Line(low, high))


def is_smooth(term: ca.SX, s: ca.SX, low: Fraction, high: Fraction | None, cases: Cases) -> bool:
    """Whether a term is seen to have two continuous derivatives on the open interval, and these are quotients of sums."""
    with _precision():
        try:
            return _read(term, s, Line(low, high), cases).second is not None
        except (Undecided, ZeroDivisionError, OverflowError):
            return False


def slope_at_start(term: ca.SX, s: ca.SX, low: Fraction, cases: Cases) -> tuple[float, float] | None:
    """Bounds of the limit of the derivative at ``low`` from the right; None where it is not found or infinite."""
    from flint import arb

    high = low + 1
    with _precision():
        for _ in range(20):
            try:
                found = _read(term, s, Line(low, high), cases).first
                if found is None:
                    return None
                order, number = _leading(found.top, low, 1)
                for part, power in found.bottom.values():
                    k, lead = _leading(part, low, 1)
                    if k or lead.contains(0):
                        return None
                    number /= lead**power
                if order < 0:
                    return None
                number = arb(0) if order > 0 else number
                return _below(number), -_below(-number) + 0.0
            except Undecided:  # a sign changes too near
                high = low + (high - low) / 8
            except (ZeroDivisionError, OverflowError):
                return None
    return None


def falls_without_end(terms: Sequence[tuple[Fraction, ca.SX]], s: ca.SX, low: Fraction, cases: Sequence[Cases]) -> bool:
    """Whether a sum of factors times terms is proved to tend to -inf: its derivative stays below -c/s, c > 0, for large s."""
    line = Line(max(low, Fraction(0)) + 1)
    with _precision():
        for _ in range(8):
            try:
                total = Quotient({}, {})
                for (factor, term), own in zip(terms, cases, strict=True):
                    part = _read(term, s, line, own).first
                    if part is None:
                        return False
                    total = _plus(total, _scaled(part, factor), 1)
                (rank, order), number = _growth(total.top)
                for part, power in total.bottom.values():
                    (own_rank, own_order), own_number = _growth(part)
                    if own_number.contains(0):
                        return False
                    rank, order, number = _quotient(rank, own_rank, power), order - own_order * power, number / own_number**power
                return bool(number < 0) and (rank > (0, ()) or (rank == (0, ()) and order >= -1))
            except Undecided:  # a sign changes further out
                line = Line(8 * line.low)
            except (ZeroDivisionError, OverflowError):
                return False
    return False


def _decided(read: Callable[[Line], Quotient | None], line: Line) -> Signs | None:
    with _precision():
        try:
            found = read(line)
            return None if found is None else _pattern(found.top, line)
        except (Undecided, ZeroDivisionError, OverflowError):
            return None


class _precision:
    """FLINT computes with so many bits inside."""

    def __enter__(self) -> None:
        from flint import ctx

        self._before, ctx.prec = ctx.prec, PRECISION

    def __exit__(self, *_: object) -> None:
        from flint import ctx

        ctx.prec = self._before


def _below(number: Any) -> float:
    import numpy as np

    mantissa, exponent = (int(part) for part in number.lower().man_exp())
    exact = Fraction(mantissa) * Fraction(2) ** exponent
    near = float(exact)
    return near if Fraction(near) <= exact else float(np.nextafter(near, -np.inf))


# -- algebra -----------------------------------------------------------------------------------------------------------


def _poly(c: Sequence[Fraction]) -> Any:
    from flint import fmpq, fmpq_poly

    return fmpq_poly([fmpq(number.numerator, number.denominator) for number in c])


def _coefficients(p: Any) -> tuple[Fraction, ...]:
    return tuple(Fraction(int(number.p), int(number.q)) for number in p.coeffs())


def _reduced(top: Any, bottom: Any) -> tuple[Any, Any]:
    common = top.gcd(bottom)
    if common.degree() > 0:
        top, bottom = top // common, bottom // common
    if max(top.degree(), bottom.degree()) > MOST_DEGREE:
        raise Undecided
    lead = bottom[bottom.degree()]
    return top / lead, bottom / lead


def _cleaned(a: Sum) -> Sum:
    out = {key: ratio for key, ratio in a.items() if ratio[0]}
    if len(out) > MOST_TERMS:
        raise Undecided
    return out


def _added(a: Sum, b: Sum, sign: int = 1) -> Sum:
    out = dict(a)
    for key, (top, bottom) in b.items():
        if key in out:
            n, d = out[key]
            out[key] = _reduced(n * bottom + sign * top * d, d * bottom)
        else:
            out[key] = sign * top, bottom
    return _cleaned(out)


def _joined(a: Key, b: Key, sign: int = 1) -> tuple[Key, Any, Any]:
    """The product (quotient) of two E as an E times a rational function."""
    powers = dict(a[0])
    top = bottom = _poly([Fraction(1)])
    for u, p in b[0]:
        total = powers.pop(u, Fraction(0)) + sign * p
        whole = total.numerator // total.denominator
        if total - whole:
            powers[u] = total - whole
        if whole > 0:
            top *= _poly(u) ** whole
        elif whole < 0:
            bottom *= _poly(u) ** -whole
    q = _coefficients(_poly(a[1]) + sign * _poly(b[1]))
    return (tuple(sorted(powers.items())), q), top, bottom


def _times(a: Sum, b: Sum) -> Sum:
    out: Sum = {}
    for left, (n, d) in a.items():
        for right, (top, bottom) in b.items():
            key, more, less = _joined(left, right)
            out = _added(out, {key: _reduced(n * top * more, d * bottom * less)})
    return out


def _constant(number: Fraction) -> Sum:
    return {ONE: (_poly([number]), _poly([Fraction(1)]))} if number else {}


def _power(a: Sum, exponent: Fraction, line: Line) -> Sum:
    """One term to a power; its rational part is to be > 0, or not 0 where the exponent is whole."""
    from flint import fmpq

    ((key, (top, bottom)),) = a.items()
    factors: dict[tuple[Fraction, ...], int] = {}
    number, sign = fmpq(1), 1
    for part, direction in ((top, 1), (bottom, -1)):
        content, parts = part.numer().factor()
        number *= fmpq(content) ** direction * fmpq(part.denom()) ** -direction
        for factor, multiple in parts:
            u = _poly([Fraction(int(c)) for c in factor.coeffs()])
            own = _sign(u, line)
            sign *= own**multiple
            u = _coefficients(u * own)
            factors[u] = factors.get(u, 0) + direction * multiple
    number *= sign
    rational = Fraction(int(number.p), int(number.q))
    if exponent.denominator != 1 and rational < 0:
        raise Undecided
    out = _constant(Fraction(1))
    if exponent.denominator == 1:
        out = _constant(rational ** int(exponent))
    elif rational != 1:
        out = _term((rational,), exponent)
    for u, multiple in factors.items():
        out = _times(out, _term(u, multiple * exponent))
    for u, p in key[0]:
        out = _times(out, _term(u, p * exponent))
    q = tuple(number * exponent for number in key[1])
    return _times(out, {((), q): (_poly([Fraction(1)]),) * 2})


def _term(u: tuple[Fraction, ...], p: Fraction) -> Sum:
    """u^p."""
    whole = p.numerator // p.denominator
    if abs(whole) * len(u) > MOST_DEGREE:
        raise Undecided
    key: Key = (((u, p - whole),) if p - whole else (), ())
    base = _poly(u) ** abs(whole)
    return {key: (base, _poly([Fraction(1)])) if whole >= 0 else _reduced(_poly([Fraction(1)]), base)}


def _sign(u: Any, line: Line) -> int:
    """The sign of a polynomial without roots on the line."""
    if not u:
        raise Undecided
    c = _coefficients(u)
    if _inner_roots(c, line):
        raise Undecided
    return 1 if polynomial_signs.at(c, _inside(line)) > 0 else -1


def _inside(line: Line) -> Fraction:
    return line.low + 1 if line.high is None else (line.low + line.high) / 2


def _inner_roots(c: Sequence[Fraction], line: Line) -> list[Place]:
    """The roots of a polynomial within the open interval."""
    found = polynomial_signs.real_roots(c, line.low, line.high)
    return [place for place in found if place != (line.low, line.low) and place != (line.high, line.high)]


# -- quotients ---------------------------------------------------------------------------------------------------------


class Jet(NamedTuple):
    """A function with its first two derivatives, each None where it is no quotient of sums."""

    value: Quotient | None
    first: Quotient | None
    second: Quotient | None


def _read(expr: ca.SX, s: ca.SX, line: Line, cases: Cases) -> Jet:
    own = s.element_hash()
    one, zero = Quotient(_constant(Fraction(1)), {}), Quotient({}, {})

    calls = iter(range(10**9))

    def symbol(item: ca.SX) -> Jet:
        if item.element_hash() != own:
            return Jet(None, None, None)
        identity = _poly([Fraction(0), Fraction(1)]), _poly([Fraction(1)])
        return Jet(Quotient({ONE: identity}, {}), one, zero)

    def number(value: float) -> Jet:
        finite = abs(value) < float("inf")
        return Jet(Quotient(_constant(Fraction(value)), {}), zero, zero) if finite else Jet(None, None, None)

    def apply(op: int, args: list[Jet]) -> Jet:
        case = cases.get(next(calls))
        if case is None:
            return _jet(op, args, line)
        out = Jet(Quotient(_constant(case[1]), {}), zero, zero)
        for factor, jet in zip(case[0], args, strict=True):
            if factor:
                out = _sum(out, jet, factor)
        return out

    return fold(expr, symbol, number, apply)[0]


def _sum(a: Jet, b: Jet, factor: int) -> Jet:
    return Jet(
        *(
            None if x is None or y is None else _plus(x, _scaled(y, abs(factor)), 1 if factor > 0 else -1)
            for x, y in zip(a, b, strict=True)
        )
    )


def _jet(op: int, args: list[Jet], line: Line) -> Jet:
    """An operation on functions and their derivatives."""
    a, b = args[0], args[-1]
    if op in (ca.OP_ADD, ca.OP_SUB):
        return _sum(a, b, 1 if op == ca.OP_ADD else -1)
    if op in (ca.OP_ASSIGN, ca.OP_NEG, ca.OP_TWICE):
        factor = {ca.OP_ASSIGN: 1, ca.OP_NEG: -1, ca.OP_TWICE: 2}[op]
        return Jet(*(None if part is None else _scaled(part, factor) for part in a))
    if op in (ca.OP_MUL, ca.OP_SQ):
        return _leibniz(a, b)
    if op == ca.OP_DIV:
        return _leibniz(a, _chain(b, _outer(ca.OP_INV, b, None, line)))
    if op in (ca.OP_POW, ca.OP_CONSTPOW):
        c = None if b.value is None else _as_polynomial(b.value)
        if c is None or len(c) > 1:
            return Jet(None, None, None)
        return _chain(a, _outer(op, a, c[0] if c else Fraction(0), line))
    return _chain(a, _outer(op, a, None, line))


def _mul(a: Quotient | None, b: Quotient | None) -> Quotient | None:
    """The product; 0 times what is not known is 0."""
    for one in (a, b):
        if one is not None and not one.top:
            return one
    return None if a is None or b is None else _product(a, b)


def _add(*parts: Quotient | None) -> Quotient | None:
    total: Quotient | None = Quotient({}, {})
    for part in parts:
        total = None if total is None or part is None else _plus(total, part, 1)
    return total


def _leibniz(a: Jet, b: Jet) -> Jet:
    cross = _mul(a.first, b.first)
    return Jet(
        _mul(a.value, b.value), _add(_mul(a.value, b.first), _mul(a.first, b.value)),
        _add(_mul(a.value, b.second), cross, cross, _mul(a.second, b.value)),
    )  # fmt: skip


def _chain(u: Jet, f: Jet) -> Jet:
    """f(u) from the jet of f at the value of u."""
    return Jet(f.value, _mul(f.first, u.first), _add(_mul(f.second, _mul(u.first, u.first)), _mul(f.first, u.second)))


def _outer(op: int, u: Jet, exponent: Fraction | None, line: Line) -> Jet:
    """The jet of an elementary function at the value of u."""
    nothing = Jet(None, None, None)
    x = u.value
    if x is None:
        return nothing
    one, zero = Quotient(_constant(Fraction(1)), {}), Quotient({}, {})
    if op in (ca.OP_POW, ca.OP_CONSTPOW, ca.OP_SQRT, ca.OP_INV):
        p = exponent if exponent is not None else Fraction(1, 2) if op == ca.OP_SQRT else Fraction(-1)
        powers = [
            zero if not factor else _mul(Quotient(_constant(factor), {}), _raised(x, p - k, line))
            for k, factor in enumerate((Fraction(1), p, p * (p - 1)))
        ]
        return Jet(*powers)
    if op in (ca.OP_EXP, ca.OP_EXPM1):
        e = _exp(x, 1)
        return Jet(e if op == ca.OP_EXP else _plus(e, one, -1), e, e)
    if op in (ca.OP_SINH, ca.OP_COSH):
        both = (
            _scaled(_plus(_exp(x, 1), _exp(x, -1), -1), Fraction(1, 2)),
            _scaled(_plus(_exp(x, 1), _exp(x, -1), 1), Fraction(1, 2)),
        )
        odd, even = both if op == ca.OP_SINH else both[::-1]
        return Jet(odd, even, odd)
    if op == ca.OP_TANH:
        v = _plus(one, _product(_scaled(one, 2), _inverse(_plus(_exp(x, 2), one, 1), line)), -1)
        d = _plus(one, _product(v, v), -1)
        return Jet(v, d, _scaled(_product(v, d), -2))
    if op in (ca.OP_LOG, ca.OP_LOG1P):
        inner = x if op == ca.OP_LOG else _plus(x, one, 1)
        if min(_pattern(inner.top, line).signs) <= 0:
            return nothing
        d = _inverse(inner, line)
        return Jet(None, d, _scaled(_product(d, d), -1))
    if op in (ca.OP_ATAN, ca.OP_ASINH):
        around = _plus(one, _product(x, x), 1)
        if op == ca.OP_ATAN:
            d = _inverse(around, line)
            return Jet(None, d, _scaled(_product(x, _product(d, d)), -2))
        d = _raised(around, Fraction(-1, 2), line)
        cube = _raised(around, Fraction(-3, 2), line)
        return Jet(None, d, None if cube is None else _scaled(_product(x, cube), -1))
    return nothing


def _scaled(a: Quotient, factor: Fraction | int) -> Quotient:
    return Quotient(_times(a.top, _constant(Fraction(factor))), a.bottom)


def _product(a: Quotient, b: Quotient) -> Quotient:
    bottom = dict(a.bottom)
    for name, (part, power) in b.bottom.items():
        bottom[name] = part, power + (bottom[name][1] if name in bottom else 0)
    return Quotient(_times(a.top, b.top), bottom)


def _plus(a: Quotient, b: Quotient, sign: int) -> Quotient:
    bottom = dict(a.bottom)
    for name, (part, power) in b.bottom.items():
        bottom[name] = part, max(power, bottom[name][1] if name in bottom else 0)
    tops = []
    for one in (a, b):
        top = one.top
        for name, (part, power) in bottom.items():
            for _ in range(power - (one.bottom[name][1] if name in one.bottom else 0)):
                top = _times(top, part)
        tops.append(top)
    return Quotient(_added(tops[0], tops[1], sign), bottom)


def _inverse(a: Quotient, line: Line) -> Quotient:
    if not a.top:
        raise Undecided
    top = _constant(Fraction(1))
    for part, power in a.bottom.values():
        for _ in range(power):
            top = _times(top, part)
    if len(a.top) == 1:
        return Quotient(_times(top, _power(a.top, Fraction(-1), line)), {})
    found = _pattern(a.top, line)
    if found.places or not found.signs[0]:
        raise Undecided
    part = _times(a.top, _constant(Fraction(found.signs[0])))
    name = frozenset((key, _coefficients(n), _coefficients(d)) for key, (n, d) in part.items())
    return Quotient(_times(top, _constant(Fraction(found.signs[0]))), {name: (part, 1)})


def _raised(a: Quotient, exponent: Fraction, line: Line) -> Quotient | None:
    if exponent.denominator == 1 and abs(exponent) <= MOST_TERMS:
        base = a if exponent >= 0 else _inverse(a, line)
        out = Quotient(_constant(Fraction(1)), {})
        for _ in range(abs(int(exponent))):
            out = _product(out, base)
        return out
    if not a.top:
        return a if exponent > 0 else None
    return None if a.bottom or len(a.top) > 1 else Quotient(_power(a.top, exponent, line), {})


def _exp(a: Quotient, factor: int) -> Quotient:
    """e^(factor a) of a polynomial."""
    c = _as_polynomial(a)
    if c is None:
        raise Undecided
    q = tuple(factor * number for number in c)
    return Quotient({((), q): (_poly([Fraction(1)]),) * 2}, {})


def _as_polynomial(a: Quotient) -> tuple[Fraction, ...] | None:
    if a.bottom or set(a.top) - {ONE}:
        return None
    if not a.top:
        return ()
    top, bottom = a.top[ONE]
    return _coefficients(top) if bottom.degree() == 0 else None


# -- signs -------------------------------------------------------------------------------------------------------------


def _pattern(F: Sum, line: Line) -> Signs:
    """The signs of a sum on the line."""
    if not F:
        return Signs([], [0])
    if len(F) == 1:
        (((top, bottom)),) = F.values()
        return _rational(_coefficients(top * bottom), line)
    common = _poly([Fraction(1)])
    for _, bottom in F.values():
        common = common * (bottom // common.gcd(bottom))
    negative = _sign(common, line) < 0
    F = {
        key: (-top * (common // bottom) if negative else top * (common // bottom), _poly([Fraction(1)]))
        for key, (top, bottom) in F.items()
    }
    last = min(F, key=lambda key: (any(not polynomial_signs.at(u, line.low) for u, _ in key[0]), F[key][0].degree()))
    chain = [{}]
    for key, (top, bottom) in F.items():
        joined, more, less = _joined(key, last, -1)
        chain[0] = _added(chain[0], {joined: _reduced(top * more, bottom * less)})
    for _ in range(F[last][0].degree() + 1):
        chain.append(_derivative(chain[-1]))
    if len(chain) > MOST_DERIVATIVES:
        raise Undecided
    found = _pattern(chain[-1], line)
    for G, slope in zip(chain[-2::-1], chain[:0:-1], strict=True):
        found = _integrated(G, slope, found, line)
    return found


def _derivative(F: Sum) -> Sum:
    out: Sum = {}
    for key, (n, d) in F.items():
        out = _added(out, {key: _reduced(n.derivative() * d - n * d.derivative(), d * d)})
        rates = [(p, u) for u, p in key[0] if len(u) > 1]
        for p, u in rates:
            base = _poly(u)
            out = _added(out, {key: _reduced(n * base.derivative() * _poly([p]), d * base)})
        if len(key[1]) > 1:
            out = _added(out, {key: _reduced(n * _poly(key[1]).derivative(), d)})
    return out


def _rational(c: Sequence[Fraction], line: Line) -> Signs:
    """The signs of a polynomial."""
    roots = _inner_roots(c, line)
    ends = [(line.low, line.low), *roots, (line.high, line.high)]
    found = Signs([], [])
    for k, (left, right) in enumerate(pairwise(ends)):
        middle = left[1] + 1 if right[0] is None else (left[1] + right[0]) / 2
        value = polynomial_signs.at(c, middle)
        sign = (value > 0) - (value < 0)
        if k and sign == found.signs[-1]:
            continue
        if k:
            found.places.append(left)
        found.signs.append(sign)
    return found


def _integrated(G: Sum, slope: Sum, known: Signs, line: Line) -> Signs:
    """The signs of a function from those of its derivative."""
    places = [_refined(slope, place, known.signs[k], G) for k, place in enumerate(known.places)]
    values = [_end(G, line.low, 1), *(_sign_on(G, place) for place in places), _end(G, line.high, -1)]
    bounds: list[Place | None] = [None, *places, None]
    found = Signs([], [])
    for k, direction in enumerate(known.signs):
        left, right = values[k], values[k + 1]
        if direction == 0:
            parts: list[int] = [left if left is not None else right if right is not None else 0]
            if left is None and right is None:
                raise Undecided
        elif left is not None and left * direction >= 0:
            parts = [direction]
        elif right is not None and right * direction <= 0:
            parts = [-direction]
        elif left is not None and right is not None:
            parts = [-direction, direction]
        else:
            raise Undecided
        if found.signs and found.signs[-1] != parts[0]:
            found.places.append(places[k - 1])
        if not found.signs or found.signs[-1] != parts[0]:
            found.signs.append(parts[0])
        if len(parts) > 1:
            found.places.append(_bracket(G, bounds[k], bounds[k + 1], parts[0], line))
            found.signs.append(parts[1])
    return found


def _refined(f: Sum, place: Place, before: int, G: Sum) -> Place:
    """The place where f changes its sign, narrow enough for the sign of G to be clear there."""
    low, high = place
    for _ in range(BISECTIONS):
        if low == high or _sign_on(G, (low, high)) is not None:
            break
        middle = (low + high) / 2
        sign = _sign_on(f, (middle, middle))
        if sign is None or sign == 0:
            break
        low, high = (middle, high) if sign == before else (low, middle)
    if _sign_on(G, (low, high)) is None:
        raise Undecided
    return low, high


def _bracket(G: Sum, left: Place | None, right: Place | None, before: int, line: Line) -> Place:
    """Where a monotone function changes its sign."""
    low = line.low if left is None else left[1]
    high = line.high if right is None else right[0]
    if high is None:
        step = Fraction(1)
        while _sign_on(G, (low + step,) * 2) != -before:
            step *= 2
            if step > 2**BISECTIONS:
                raise Undecided
        high = low + step
    a, b = low, high
    for _ in range(64):
        middle = (a + b) / 2
        sign = _sign_on(G, (middle, middle))
        if not sign:
            break
        a, b = (middle, b) if sign == before else (a, middle)
    return a, b


def _ball(place: Place) -> Any:
    from flint import arb, fmpq

    low, high = (arb(fmpq(end.numerator, end.denominator)) for end in place)
    return low.union(high) if place[0] != place[1] else low


def _at(p: Any, x: Any) -> Any:
    from flint import arb

    total = arb(0)
    for number in reversed(p.coeffs()):
        total = total * x + arb(number)
    return total


def _value(F: Sum, place: Place) -> Any:
    from flint import arb, fmpq

    x, total = _ball(place), arb(0)
    for (powers, q), (top, bottom) in F.items():
        term = _at(top, x) / _at(bottom, x)
        for u, p in powers:
            term *= _at(_poly(u), x) ** arb(fmpq(p.numerator, p.denominator))
        total += term * _at(_poly(q), x).exp()
    return total


def _sign_on(F: Sum, place: Place) -> int | None:
    """The sign of F on a place; None where it is not clear."""
    value = _value(F, place)
    return 1 if value > 0 else -1 if value < 0 else 0 if value.is_zero() else None


def _end(F: Sum, end: Fraction | None, side: int) -> int | None:
    """The sign of F close to an end of the line, 0 where its limit is 0; None where it is not clear."""
    order, number = _far(F) if end is None else _leading(F, end, side)
    if number > 0 or number < 0:
        return 1 if number > 0 else -1
    return 0 if number.is_zero() and order == 0 else None


def _leading(F: Sum, at: Fraction, side: int) -> tuple[Fraction, Any]:
    """(k, c) of F = c |s - at|^k + smaller terms close to ``at``, on its right (side 1) or left (-1)."""
    from flint import arb, fmpq

    shift = _poly([at, Fraction(1)])
    parts: list[tuple[Fraction, Any]] = []
    for (powers, q), (top, bottom) in F.items():
        order, number = Fraction(0), _at(_poly(q), _ball((at, at))).exp()
        for p, u in [(Fraction(1), top), (Fraction(-1), bottom), *((p, _poly(u)) for u, p in powers)]:
            c = u(shift).coeffs()
            k = next(i for i, entry in enumerate(c) if entry)
            order += k * p
            lead = arb(c[k]) * side**k
            number *= lead if p == 1 else 1 / lead if p == -1 else lead ** arb(fmpq(p.numerator, p.denominator))
        parts.append((order, number))
    return _dominant(parts, min)


def _dominant(parts: list[tuple[Any, Any]], which: Any) -> tuple[Any, Any]:
    from flint import arb

    if not parts:
        return Fraction(0), arb(0)
    order = which(order for order, _ in parts)
    return order, sum((number for own, number in parts if own == order), arb(0))


def _far(F: Sum) -> tuple[Any, Any]:
    """The leading term at infinity; its order is 0 where every term is bounded and the largest ones are numbers."""
    (rank, order), number = _growth(F)
    return Fraction(1 if rank != (0, ()) or order else 0), number


def _growth(F: Sum) -> tuple[tuple[Rank, Fraction], Any]:
    """((rank of the exponential, power of s), coefficient) of the leading term at infinity."""
    from flint import arb, fmpq

    parts: list[tuple[Any, Any]] = []
    for (powers, q), (top, bottom) in F.items():
        order = Fraction(top.degree() - bottom.degree())
        number = arb(top[top.degree()]) / arb(bottom[bottom.degree()])
        for u, p in powers:
            order += p * (len(u) - 1)
            number *= arb(fmpq(u[-1].numerator, u[-1].denominator)) ** arb(fmpq(p.numerator, p.denominator))
        if q:
            number *= arb(fmpq(q[0].numerator, q[0].denominator)).exp()
        growth = tuple(reversed(q[1:]))
        parts.append(((_ranked(growth), order), number))
    return _dominant(parts, max) if parts else (((0, ()), Fraction(0)), arb(0))


def _quotient(rank: Rank, other: Rank, power: int) -> Rank:
    """The rank of e^q / e^(power r) from those of e^q and e^r."""
    size = max(len(rank[1]), len(other[1]))
    q, r = ((Fraction(0),) * (size - len(own[1])) + own[1] for own in (rank, other))
    return _ranked(tuple(a - power * b for a, b in zip(q, r, strict=True)))


def _ranked(growth: tuple[Fraction, ...]) -> Rank:
    """A key that orders exponents q, given from the highest power down, by their size at infinity."""
    while growth and not growth[0]:
        growth = growth[1:]
    if not growth:
        return 0, ()
    return (len(growth), growth) if growth[0] > 0 else (-len(growth), growth)
