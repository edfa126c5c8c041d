"""Verify a certificate of ``nsmodel check --certificate``: python verify.py certificate.json

This file needs nothing but Python, and trusts nothing in the certificate: each statement is proved anew from the model's data, in
fractions and in intervals of fractions; hints (matrices, vectors, ways to cut a box) serve where they can be checked. It prints
the model as it reads it, and of each statement the sentence that was proved, made from the model and the numbers, never the words
of the certificate. The answer is "yes" with that sentence, "no" with a reason, or "not checkable" with a reason.

A function is a straight-line program: steps ["in", k], ["const", c], ["add", i, j], ["mul", i, j], ["pow", i, exponent],
["fmax", i, j], and ["exp", i], the same with sin, cos, tanh, where i and j are numbers of earlier steps. It is the real function
that is defined where each of its steps is: u^n for all u if n is an integer >= 0, where u is not 0 if n is an integer < 0, and
else where u >= 0, or u > 0 if n < 0.

A rule's docstring names the theorem and its premises, numbered; comments #1, #2, ... say where each is checked.
"""

from __future__ import annotations

import decimal
import hashlib
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction as Q
from itertools import accumulate, pairwise, product
from typing import Any

FORMAT = 4  # Of the certificates that this file reads.
BITS = 80  # Intervals are rounded outwards to so many bits: 27 more than doubles have, so that stated doubles have room for it.
CONTEXT = decimal.Context(prec=60)
# BIG: larger numbers are rounded to infinity, smaller ones than 1/BIG to 0 or 1/BIG.
ZERO, ONE, HALF, BIG, INF = Q(0), Q(1), Q(1, 2), Q(2) ** 1000, math.inf
PI = Q("3.14159265358979323846264338327950288")  # To 1e-35.
# More than these is not checked: exponents, powers multiplied out, terms and bits of a polynomial, operations in all.
MAX_EXPONENT, MAX_EXPANDED_POWER, MAX_TERMS, MAX_BITS, MAX_WORK, SPENT = 1000, 16, 20000, 200000, 5 * 10**7, [-INF]
YES, NO, UNCHECKED = "yes", "no", "not checkable"
Matrix = list[list[Q]]
Leaf = Callable[..., bool]
Monomial = tuple[tuple[int, int], ...]
Parameters = dict[str, "Poly"]  # low + (high - low) unit of each.
Switch = tuple[Q, list[Q], Q]  # w, a, c of w l a with l in Sgn(a'x + c), w >= 0: the subdifferential of w |a'x + c|.
NUMBER = re.compile(r"-?[0-9]{1,4000}(/[1-9][0-9]{0,3999})?", re.ASCII)
NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.]{0,40}", re.ASCII)
UP, DOWN = decimal.ROUND_CEILING, decimal.ROUND_FLOOR
FIRST_UNIT, FIRST_ATOM = 10**5, 10**6  # Variables of polynomials: inputs 0, 1, ... below, units and atoms from here on.
MAX_PARAMETERS = 1000  # Of a statement; more are not checked. Units of functions of parameters begin at FIRST_UNIT + 1000.
MAX_CORNERS = 4096  # Of a box, 2^12 of 12 parameters: at each a matrix is decided; more are not checked.


class Unproved(Exception):
    """A premise of a theorem is not met (NO), or this file knows no proof (UNCHECKED)."""


def need(true: bool, text: str, kind: str = NO) -> None:
    """Raise unless it is True; anything else, also what Python takes for true, is a failure."""
    if true is not True:
        raise Unproved(text, kind)


def spend(count: int) -> None:
    """Count operations on numbers, so that no statement takes for ever; -inf where none is looked at."""
    SPENT[0] += count
    need(SPENT[0] <= MAX_WORK, "more work than this file does", UNCHECKED)


def entries(item: Any, count: int | None = None, kind: type = list) -> Any:
    """A JSON array (or object), of so many entries where that is given."""
    need(type(item) is kind and count in (None, len(item)), "a list or an object is missing, or has another length")
    return item


def field(item: Any, name: str, kind: type | None = None) -> Any:
    """An entry of a JSON object; where ``kind`` is given, of this type, and empty where it is missing or null."""
    value = entries(item, kind=dict).get(name)
    need(name in item or kind is not None, f"'{name}' is missing")
    return value if kind is None else entries(kind() if value is None else value, kind=kind)


def names_of(item: Any) -> list[str]:
    """A list of different texts, at least one letter each."""
    need(all(type(name) is str and name != "" for name in entries(item)), "a name is no text")
    need(len(set(item)) == len(item), "two inputs have one name")
    return item


def index(item: Any, count: int) -> int:
    """An integer from 0 to count - 1."""
    need(type(item) is int and 0 <= item < count, "an index is out of range")
    return item


def number(item: Any, infinite: bool = False, parameters: Parameters | None = None) -> Any:
    """A finite number, "-3/4" or "7"; where it is allowed also "inf", "-inf", or a function of parameters alone, as a Poly."""
    if infinite and item in ("inf", "-inf"):
        return float(item)
    if parameters is not None and type(item) is dict:
        need(defined(program := VerifierProgram(item, [], 1, parameters), []), "a number without value")
        return plain(Atoms().read(program)[0])
    need(type(item) is str and NUMBER.fullmatch(item) is not None, "a number is not written as a fraction")
    return Q(item)


def vector(item: Any, count: int | None = None, parameters: Parameters | None = None, infinite: bool = False) -> list[Any]:
    """A list of numbers."""
    return [number(entry, infinite, parameters) for entry in entries(item, count)]


def matrix(item: Any, rows: int | None, columns: int, parameters: Parameters | None = None) -> Matrix:
    """The rows of a matrix of this size."""
    return [vector(row, columns, parameters) for row in entries(item, rows)]


def vanishes(A: Matrix) -> bool:
    """Whether all entries are 0."""
    return not any(x for row in A for x in row)


def escaped(item: Any) -> str:
    """Foreign text on one line: a name of letters, digits, _ and . as it is, else quoted, in ASCII, the rest written out."""
    item = item if type(item) is str else f"<no text: {type(item).__name__}>"
    return item if NAME.fullmatch(item) else ascii(item[:120] + "..." * (len(item) > 120))


def written(x: Any, rounding: str = decimal.ROUND_HALF_EVEN) -> str:
    """A number: exactly where that is short, else as a decimal of 15 digits rounded in a direction."""
    if abs(x) == INF or len(str(x)) <= 12:
        return str(x)
    return str(rounded_by(decimal.Context(prec=15, rounding=rounding), x))


def transpose(A: Matrix) -> Matrix:
    """A' of a matrix that has rows."""
    return [list(row) for row in zip(*A, strict=True)]


def dot(a: Iterable[Any], b: Iterable[Any]) -> Any:
    """The scalar product <a, b>."""
    return sum((x * y for x, y in zip(a, b, strict=True) if x and y), ZERO)


def times(A: Matrix, B: Matrix) -> Matrix:
    """The product of two matrices."""
    columns = transpose(B)
    return [[dot(row, column) for column in columns] for row in A]


def plus(A: Any, B: Any, factor: Any = 1) -> Any:
    """The sum of A and of B times a number."""
    return [[a + factor * b for a, b in zip(r, s, strict=True)] for r, s in zip(A, B, strict=True)]


def eye(n: int, entry: Any = 1) -> Matrix:
    """A number times the identity."""
    return [[Q(entry) if i == j else ZERO for j in range(n)] for i in range(n)]


def psd(M: Matrix, definite: bool = False) -> bool:
    """Whether M + M' is positive semidefinite (or definite): its LDL' factorisation with the largest pivots first.
    With parameters: it is so of all matrices in whose convex hull M lies.
    """
    n, S = len(M), plus(M, transpose(M)) if M else []
    if any(isinstance(x, Poly) for row in M for x in row):
        found = corners([x for row in M for x in row])
        return all(psd([c[i * n : (i + 1) * n] for i in range(n)], definite) for c in found)
    left = list(range(n))
    while left:
        k = max(left, key=lambda i: S[i][i])
        if S[k][k] <= 0:
            return not definite and all(S[i][j] == 0 for i in left for j in left)
        left.remove(k)
        for i in left:
            factor = S[i][k] / S[k][k]
            S[i] = [x - factor * y for x, y in zip(S[i], S[k], strict=True)] if factor else S[i]
    return True


def rounded(x: Any, up: bool = False) -> Any:
    """The number x rounded down or up to BITS bits; beyond BIG to infinity, and to 0 or 1/BIG where it is smaller."""
    if abs(x) > BIG:
        return (INF if up else BIG) if x > 0 else -rounded(-x, not up)
    n, d = x.numerator, x.denominator
    if n and d.bit_length() - n.bit_length() > 1000:
        return (1 / BIG if up else ZERO) if x > 0 else -rounded(-x, not up)
    if not n or (d & (d - 1) == 0 and n.bit_length() <= BITS):
        return Q(x)
    shift = BITS - n.bit_length() + d.bit_length()
    over, under = (n << shift, d) if shift > 0 else (n, d << -shift)
    whole = -(-over // under) if up else over // under
    return Q(whole, 1 << shift) if shift > 0 else Q(whole << -shift)


def end_product(a: Any, b: Any) -> Any:
    """The product of two ends, with 0 inf = 0."""
    if not a or not b:
        return ZERO
    if abs(a) == INF or abs(b) == INF:
        return INF if (a > 0) == (b > 0) else -INF
    return a * b


class VerifierInterval:
    """The numbers x with lo <= x <= hi, at least one; ends are fractions or infinite; operations round outwards."""

    def __init__(self, lo: Any, hi: Any = None, slack: Any = 0) -> None:
        hi = lo if hi is None else hi
        need(lo <= hi and lo < INF and hi > -INF, "an interval is empty")
        self.lo, self.hi = rounded(lo - slack if slack else lo), rounded(hi + slack if slack else hi, True)

    def __add__(self, other: VerifierInterval) -> VerifierInterval:
        return VerifierInterval(self.lo + other.lo, self.hi + other.hi)

    def __neg__(self) -> VerifierInterval:
        return VerifierInterval(-self.hi, -self.lo)

    def __mul__(self, other: Any) -> VerifierInterval:
        other = span(other)
        ends = [end_product(a, b) for a in (self.lo, self.hi) for b in (other.lo, other.hi)]
        return VerifierInterval(min(ends), max(ends))

    def __str__(self) -> str:
        """An interval inside this one, and this one but for rounding."""
        left, right = "[" if self.lo > -INF else "(", "]" if self.hi < INF else ")"
        return f"{left}{written(self.lo, UP)}, {written(self.hi, DOWN)}{right}"

    def middle(self) -> Any:
        """Where a cover cuts: where an end is infinite at 0, or twice as far out."""
        if self.hi < INF:
            return (self.lo + self.hi) / 2 if self.lo > -INF else min(2 * self.hi, -ONE)
        return max(2 * self.lo, ONE) if self.lo > -INF else ZERO

    def rising(self, f: Callable[[Any], VerifierInterval]) -> VerifierInterval:
        """The values of an increasing function that encloses its values at ends."""
        return VerifierInterval(f(self.lo).lo, f(self.hi).hi)

    def power(self, n: Any) -> VerifierInterval:
        """The power x^n, n a fraction."""
        n = Q(n)
        if n.denominator > 1:
            need(n.denominator == 2, "a power that is no root", UNCHECKED)
            need(self.lo > 0 or (self.lo == 0 and n > 0), "a power of what may be negative, or of 0")
            return self.rising(root_of).power(n.numerator)
        if n < 0:
            need(self.lo > 0 or self.hi < 0, "a division by what may be 0")
            return VerifierInterval(*(ZERO if abs(x) == INF else 1 / x for x in (self.hi, self.lo))).power(-n)
        ends = sorted((self.lo**n.numerator, self.hi**n.numerator)) if n else [ONE, ONE]
        return VerifierInterval(ZERO if n and n % 2 == 0 and self.lo < 0 < self.hi else ends[0], ends[1])

    def sin(self, quarters: int = 0) -> VerifierInterval:
        """The sine of x + quarters pi/2, quarters 0 or 1: the value in the middle, and the slope 1."""
        if self.lo == self.hi == 0:
            return VerifierInterval(Q(quarters))
        if self.hi - self.lo > 7:
            return VerifierInterval(-ONE, ONE)
        middle, half = (self.lo + self.hi) / 2 + quarters * PI / 2, (self.hi - self.lo) / 2
        k = round(middle / PI)
        y, series = rounded(middle - k * PI), ZERO
        term = -y if k % 2 else y
        for i in range(1, 36, 2):
            series, term = series + term, rounded(-term * y * y / ((i + 1) * (i + 2)))
        slack = half + Q(abs(k) + 2, 2**70)
        return VerifierInterval(max(series - slack, -ONE), min(series + slack, ONE))


def root_of(x: Any) -> VerifierInterval:
    """The root of an end >= 0."""
    if x == INF:
        return VerifierInterval(BIG, INF)
    shift = max(0, BITS - (x.numerator.bit_length() - x.denominator.bit_length()) // 2)
    low = Q(math.isqrt((x.numerator << 2 * shift) // x.denominator), 1 << shift)
    return VerifierInterval(low, low if low * low == x else low + Q(1, 1 << shift))


def rounded_by(context: decimal.Context, x: Q) -> decimal.Decimal:
    """A number as a decimal."""
    return context.divide(decimal.Decimal(x.numerator), decimal.Decimal(x.denominator))


def exp_of(x: Any) -> VerifierInterval:
    """The exponential of an end. Python rounds exp of decimals correctly, to 60 digits here; e^700 > BIG."""
    if abs(x) > 700:
        return VerifierInterval(BIG, INF) if x > 0 else VerifierInterval(ZERO, 1 / BIG)
    value = Q(CONTEXT.exp(rounded_by(CONTEXT, x)))
    return VerifierInterval(value, slack=value / 2**150 if x else 0)


Box = list[VerifierInterval]
IntervalMatrix = list[list[VerifierInterval]]
Jets = list["VerifierJet"]
UNIT, ALL = VerifierInterval(ONE), VerifierInterval(-INF, INF)
FUNCTIONS: dict[str, Callable[[VerifierInterval], tuple[VerifierInterval, ...]]] = {  # f(x), f'(x), f''(x)
    "exp": lambda x: (x.rising(exp_of),) * 3,
    "sin": lambda x: (x.sin(), x.sin(1), -x.sin()),
    "cos": lambda x: (x.sin(1), -x.sin(), -x.sin(1)),
    # 1 - 2/(e^2x + 1), in which x occurs once.
    "tanh": lambda x: (
        t := UNIT + ((x * 2).rising(exp_of) + UNIT).power(-1) * -2, d := UNIT + -t.power(2), t * d * -2
    ),
}  # fmt: skip


def length(row: Iterable[VerifierInterval]) -> VerifierInterval:
    """The Euclidean length."""
    return sum((x.power(2) for x in row), VerifierInterval(ZERO)).power(HALF)


def symmetric_below(A: Matrix, P: Matrix, L: Q) -> bool:
    """Whether P A + A'P <= 2 L P, P symmetric."""
    return psd(plus([[L * x for x in row] for row in P], times(P, A), -1)) if P else True


def interval_psd(H: IntervalMatrix) -> bool:
    """Whether all symmetric matrices in H are psd: the middle is, with the lower ends on the diagonal, less each row's radii."""
    n = range(len(H))
    radii = [sum((H[i][j].hi - H[i][j].lo for j in n if j != i), ZERO) / 2 for i in n]
    if not all(H[i][i].lo > -INF and radii[i] < INF for i in n):
        return False
    return psd([[H[i][i].lo - radii[i] if i == j else H[i][j].middle() for j in n] for i in n])


def norm_below(J: IntervalMatrix, K: Q) -> bool:
    """Whether |J| <= K in the spectral norm for all J in an interval matrix: [K, J; J', K] is psd."""
    m, n, k, zero = len(J), len(J[0]) if J else 0, VerifierInterval(K), VerifierInterval(ZERO)
    upper = [[k if i == j else zero for j in range(m)] + J[i] for i in range(m)]
    return interval_psd(upper + [[J[i][j] for i in range(m)] + [k if j == l else zero for l in range(n)] for j in range(n)])


def form_below(J: IntervalMatrix, P: Matrix, L: Q) -> bool:
    """Whether P J + J'P <= 2 L P for all J in an interval matrix."""
    n = range(len(P))
    PJ = [[sum((J[k][b] * P[a][k] for k in n), VerifierInterval(ZERO)) for b in n] for a in n]
    return interval_psd([[span(2 * L * P[a][b]) + -PJ[a][b] + -PJ[b][a] for b in n] for a in n])


class VerifierProgram:
    """A function of named inputs, from JSON: its steps, each of earlier ones, and which of them are its values.
    The inputs have different names, the last are the parameters, and the first n the others; the steps have the forms of this
    file's docstring, and exponents are at most MAX_EXPONENT.
    """

    def __init__(self, data: Any, inputs: Sequence[str] | None, outputs: int | None, parameters: Parameters) -> None:
        self.inputs, self.parameters = names_of(field(data, "inputs")), parameters
        self.own, self.n = self.inputs[: len(self.inputs) - len(parameters)], len(self.inputs) - len(parameters)
        need([*self.own, *parameters] == self.inputs, "a function leaves out a parameter")
        need(inputs is None or self.own == inputs, "a function has other inputs")
        need(len(self.inputs) <= FIRST_UNIT, "a function has too many inputs", UNCHECKED)
        need("steps" in data, f"a function that is not written down: {escaped(data.get('why'))}", UNCHECKED)
        self.steps: list[tuple[str, Any, Any]] = []
        self.steps.extend(self._read_step(*entries(step)) for step in entries(data["steps"]))
        self.outputs = [index(k, len(self.steps)) for k in entries(field(data, "outputs"), outputs)]
        self.used = {i for op, i, _ in self.steps if op == "in"}

    def _read_step(self, op: Any, i: Any, *rest: Any) -> tuple[str, Any, Any]:
        count = len(self.steps)
        need(len(rest) == (op in ("add", "mul", "fmax", "pow")), "a step has too much or too little")
        if op in ("in", "const"):
            return op, index(i, len(self.inputs)) if op == "in" else number(i), None
        if op == "pow":
            n = number(rest[0])
            need(abs(n) <= MAX_EXPONENT, "an exponent that is too large", UNCHECKED)
            return op, index(i, count), n
        need(type(op) is str and (op in FUNCTIONS or len(rest) == 1), "a step has no such operation")
        return op, index(i, count), index(rest[0], count) if rest else None

    def run(self, inputs: Sequence[Any], const: Callable[[Q], Any], apply: Callable[[str, Any, Any], Any]) -> list[Any]:
        """The values in an algebra with + and *; ``apply(op, u, w)`` does the other operations, w the second argument."""
        nodes: list[Any] = []
        for op, i, w in self.steps:
            if op in ("in", "const"):
                nodes.append(inputs[i] if op == "in" else const(i))
            elif op in ("add", "mul"):
                nodes.append(nodes[i] + nodes[w] if op == "add" else nodes[i] * nodes[w])
            else:
                nodes.append(apply(op, nodes[i], nodes[w] if op == "fmax" else w))
        return [nodes[k] for k in self.outputs]


class VerifierJet:
    """Value, gradient and Hessian on a box, in intervals; gradient and Hessian may be left out."""

    def __init__(self, v: VerifierInterval, g: list[VerifierInterval], H: IntervalMatrix) -> None:
        self.v, self.g, self.H = v, g, H

    def __add__(self, o: VerifierJet) -> VerifierJet:
        H = [[a + b for a, b in zip(r, s, strict=True)] for r, s in zip(self.H, o.H, strict=True)]
        return VerifierJet(self.v + o.v, [a + b for a, b in zip(self.g, o.g, strict=True)], H)

    def __mul__(self, o: VerifierJet) -> VerifierJet:
        n, g = range(len(self.H)), [self.v * b + o.v * a for a, b in zip(self.g, o.g, strict=True)]
        H = [[self.v * o.H[i][j] + o.v * self.H[i][j] + self.g[i] * o.g[j] + self.g[j] * o.g[i] for j in n] for i in n]
        return VerifierJet(self.v * o.v, g, H)

    def chain(self, f: VerifierInterval, d: Any, dd: Any) -> VerifierJet:
        """The function f of it, with its derivatives d and dd there."""
        n = range(len(self.H))
        H = [[dd * self.g[i] * self.g[j] + d * self.H[i][j] for j in n] for i in n]
        return VerifierJet(f, [d * a for a in self.g], H)

    def larger(self, o: VerifierJet, smooth: bool) -> VerifierJet:
        """The maximum. Where one is not strictly larger on the closed part, there may be a kink: then the hull of the gradients.
        Being strict matters: a kink on the common side of two parts would else be seen from neither.
        """
        if self.v.lo > o.v.hi or o.v.lo > self.v.hi:
            return self if self.v.lo > o.v.hi else o
        need(not self.g or not (smooth or self.H), "a kink")
        g = [VerifierInterval(min(a.lo, b.lo), max(a.hi, b.hi)) for a, b in zip(self.g, o.g, strict=True)]
        return VerifierJet(VerifierInterval(max(self.v.lo, o.v.lo), max(self.v.hi, o.v.hi)), g, [])


def jets(program: VerifierProgram, box: Box, order: int = 2, wrt: Iterable[int] | None = None, smooth: bool = False) -> Jets:
    """The jet of each value on a closed box, for all values of the parameters where the box has none; derivatives up to
    ``order`` by the inputs ``wrt`` (None: all that are no parameters).
    It returns only if the function is defined on the whole box, and, with order 2, or ``smooth`` and order 1, has continuous
    derivatives of this order at each point of the box. With order 1 alone gradients hold all limits of gradients at kinks.
    """
    own = list(range(program.n) if wrt is None else wrt)
    zero = [VerifierInterval(ZERO)] * len(own) if order else []
    flat = [zero] * len(own) if order > 1 else []

    def apply(op: str, u: VerifierJet, w: Any) -> VerifierJet:
        if op == "fmax":
            return u.larger(w, smooth)
        if op == "pow":
            factors = [w, w * (w - 1)][:order]
            slopes = [u.v.power(w - 1 - k) * f if f else zero[0] for k, f in enumerate(factors)]
            return u.chain(u.v.power(w), *slopes, *[None] * (2 - order))
        return u.chain(*FUNCTIONS[op](u.v))

    box = [*box, *map(span, program.parameters.values())] if len(box) == program.n else box
    need(len(box) == len(program.inputs), "a box has another size")
    spend(len(program.steps) * (1 + len(own) ** order))
    units = [[VerifierInterval(ONE if k == i else ZERO) for i in own] if order else [] for k in range(len(box))]
    inputs = [VerifierJet(x, unit, flat) for x, unit in zip(box, units, strict=True)]
    return program.run(inputs, lambda c: VerifierJet(VerifierInterval(c), zero, flat), apply)


def cover(tree: Any, box: Box, leaf: Callable[[Box, Any], bool]) -> bool:
    """Whether ``leaf`` holds on each part: a tree [coordinate, left, right] halves the box; anything else is a hint."""
    if type(tree) is list and len(tree) == 3 and type(tree[0]) is int:
        k = index(tree[0], len(box))
        middle = box[k].middle()
        sides = VerifierInterval(box[k].lo, middle), VerifierInterval(middle, box[k].hi)
        return all(cover(part, [*box[:k], side, *box[k + 1 :]], leaf) for part, side in zip(tree[1:], sides, strict=True))
    return leaf(box, tree)


class Poly(dict[Monomial, Q]):
    """A polynomial {monomial: coefficient}; a monomial is ((variable, exponent), ...), variables rising, exponents > 0."""

    def __init__(self, terms: dict[Monomial, Q]) -> None:
        spend(len(terms))
        super().__init__({m: a for m, a in terms.items() if a})
        sizes = [a.numerator.bit_length() + a.denominator.bit_length() for a in self.values()]
        need(len(sizes) <= MAX_TERMS and max(sizes, default=0) <= MAX_BITS, "a polynomial that is too long", UNCHECKED)
        for m in self:
            need(all(type(v) is int and type(n) is int and n > 0 for v, n in m), "an exponent is no integer > 0")
            need(all(a < b for (a, _), (b, _) in pairwise(m)), "a monomial names a variable twice")

    def __add__(self, o: Any) -> Poly:
        o = o if isinstance(o, Poly) else constant(o)
        return Poly({m: self.get(m, ZERO) + o.get(m, ZERO) for m in {**self, **o}})

    def __neg__(self) -> Poly:
        return Poly({m: -a for m, a in self.items()})

    def __mul__(self, o: Any) -> Poly:
        o = o if isinstance(o, Poly) else constant(o)
        spend(len(self) * len(o))
        terms: dict[Monomial, Q] = {}
        for (m, a), (k, b) in product(self.items(), o.items()):
            powers = dict(m)
            for v, n in k:
                powers[v] = powers.get(v, 0) + n
            both = tuple(sorted(powers.items()))
            terms[both] = terms.get(both, ZERO) + a * b
        return Poly(terms)

    __radd__, __rmul__ = __add__, __mul__

    def number(self) -> Q | None:
        """Its value where it is a constant."""
        return self.get((), ZERO) if set(self) <= {()} else None


def constant(c: Any) -> Poly:
    """A number as a polynomial."""
    return Poly({(): Q(c)})


def variable(v: int, c: Any = 1) -> Poly:
    """A variable times a number."""
    return Poly({((v, 1),): Q(c)})


def is_unit(v: int) -> bool:
    """Whether a variable is a unit: a number between 0 and 1 that a parameter with values between low and high moves with, which
    is low + (high - low) unit; or what a function of parameters moves with in the same way, as if it varied independently.
    """
    return FIRST_UNIT <= v < FIRST_ATOM


def between(k: int, low: Q, high: Q) -> Poly:
    """What moves from low to high with unit k."""
    need(k < MAX_PARAMETERS, "too many parameters", UNCHECKED)
    return variable(FIRST_UNIT + k, high - low) + low


def corners(polys: Sequence[Any]) -> list[list[Q]]:
    """Points in whose convex hull (p_1, p_2, ...) lies, of numbers and polynomials of units, for all values of these: the
    coefficients in Bernstein's polynomials, which are >= 0 on [0, 1] and have the sum 1.
    """
    terms = [x if isinstance(x, Poly) else constant(x) for x in polys]
    degrees: dict[int, int] = {}
    for v, n in (pair for p in terms for m in p for pair in m):
        degrees[v] = max(n, degrees.get(v, 0))
    few = all(map(is_unit, degrees)) and math.prod(n + 1 for n in degrees.values()) <= MAX_CORNERS
    need(few, "more than polynomials of a few parameters", UNCHECKED)
    found = []
    for corner in product(*(range(n + 1) for n in degrees.values())):
        at = dict(zip(degrees, corner, strict=True))
        share = lambda m, at=at: math.prod((Q(math.comb(at[v], n), math.comb(degrees[v], n)) for v, n in m), start=ONE)  # noqa: E731
        found.append([sum((a * share(m) for m, a in p.items()), ZERO) for p in terms])
    return found


def at_corners(p: Poly) -> list[Poly]:
    """Polynomials without units in whose convex hull p lies for all values of the units, those in its atoms aside."""
    parts: dict[Monomial, dict[Monomial, Q]] = {}
    for m, a in p.items():
        units = tuple(pair for pair in m if is_unit(pair[0]))
        parts.setdefault(tuple(pair for pair in m if pair not in units), {})[units] = a
    return [Poly(dict(zip(parts, corner, strict=True))) for corner in corners([Poly(part) for part in parts.values()])]


def least(x: Any) -> Any:
    """A number that x, a number or a polynomial of units, is not below."""
    return min(c for (c,) in corners([x])) if isinstance(x, Poly) else x


def gap(low: Any, high: Any) -> Any:
    """A number that high - low is not below, of ends."""
    return INF if low == -INF or high == INF else least(high + -low)


def span(x: Any) -> VerifierInterval:
    """The values of an interval, a number, or a polynomial of units."""
    return x if isinstance(x, VerifierInterval) else VerifierInterval(least(x), -least(-x))


def plain(p: Poly) -> Any:
    """The polynomial, as a number where it is one."""
    return p if (c := p.number()) is None else c


class Atoms:
    """Each operation that is no polynomial is a new variable, the same for the same operation on the same polynomials: of
    parameters alone a unit, else an atom. ``nonnegative`` has inputs that are >= 0.
    """

    units: dict[Any, Poly] = {}  # noqa: RUF012  What functions of units are: the same for all models.

    def __init__(self, nonnegative: Iterable[int] = ()) -> None:
        self.known: dict[Any, int] = {}
        self.meaning: dict[int, tuple[Any, ...]] = {}
        self.nonnegative = set(nonnegative)

    def of(self, op: str, *args: Any) -> Poly:
        """The atom of an operation; of units alone low + (high - low) unit, as the operation has values from low to high."""
        parts = [frozenset(part.items()) if isinstance(part, Poly) else part for part in args]
        key = (op, frozenset(parts)) if op == "fmax" else (op, *parts)
        if all(is_unit(v) for part in args if isinstance(part, Poly) for m in part for v, _ in m):
            if key not in self.units:
                x, y = span(args[0]), span(args[-1])
                if op == "fmax":
                    x = VerifierInterval(max(x.lo, y.lo), max(x.hi, y.hi))
                else:
                    x = x.power(args[1]) if op == "pow" else FUNCTIONS[op](x)[0]
                v = FIRST_UNIT + MAX_PARAMETERS + len(self.units)
                need(x.lo > -INF and x.hi < INF and v < FIRST_ATOM, "an infinite number", UNCHECKED)
                self.units[key] = variable(v, x.hi - x.lo) + x.lo
            return self.units[key]
        v = self.known.setdefault(key, FIRST_ATOM + len(self.known))
        self.meaning[v] = (op, *args)
        return variable(v)

    def apply(self, op: str, u: Poly, w: Any) -> Poly:
        """An operation on polynomials: powers are expanded where they can be."""
        whole, c = op == "pow" and w.denominator == 1 and abs(w) <= MAX_EXPANDED_POWER, u.number()
        if whole and w >= 0:
            return math.prod([u] * int(w), start=constant(ONE))
        return constant(c**w) if whole and c else self.of(op, u, *([] if w is None else [w]))

    def read(self, program: VerifierProgram) -> list[Poly]:
        """The values of a program as polynomials: equal to it wherever it is defined."""
        return program.run([*map(variable, range(program.n)), *program.parameters.values()], constant, self.apply)

    def inputs(self, *polys: Poly) -> set[int]:
        """The inputs that polynomials depend on, through atoms too."""
        own = {v for p in polys for m in p for v, _ in m}
        inner = [part for v in own if v in self.meaning for part in self.meaning[v][1:] if isinstance(part, Poly)]
        return {v for v in own if v not in self.meaning} | (self.inputs(*inner) if inner else set())

    def feels(self, v: int, own: Iterable[int]) -> bool:
        """Whether a variable depends on one of these inputs."""
        return bool(self.inputs(variable(v)) & set(own))


def slope(p: Poly, k: int, atoms: Atoms) -> Poly:
    """The derivative of a polynomial by the variable k, which is in none of its atoms."""
    need(not any(v in atoms.meaning and atoms.feels(v, [k]) for m in p for v, _ in m), "a derivative", UNCHECKED)
    lower = {m: tuple((v, n - (v == k)) for v, n in m if n > (v == k)) for m in p if k in dict(m)}
    return Poly({lower[m]: p[m] * dict(m)[k] for m in lower})


def squares(hint: Any) -> Poly:
    """The sum of squares m'G m of monomials m and a psd G: >= 0 whatever its variables are."""
    pairs = [[tuple(entries(pair, 2)) for pair in entries(one)] for one in entries(field(hint, "monomials"))]
    need(all(type(x) is int for one in pairs for pair in one for x in pair), "a monomial has no integers")
    m, G = [Poly({tuple(sorted(one)): ONE}) for one in pairs], matrix(field(hint, "G"), len(pairs), len(pairs))
    need(psd(G), "G is not psd")
    return sum((a * b * G[i][j] for (i, a), (j, b) in product(enumerate(m), enumerate(m))), Poly({}))


def affine(polys: Iterable[Poly], own: Sequence[int], atoms: Atoms) -> tuple[Matrix, list[Poly]]:
    """A and b: the polynomials are A own + b, b free of these inputs, A of all but units."""
    A, b = [], []
    for p in polys:
        row: dict[int, dict[Monomial, Q]] = {v: {} for v in own}
        rest = dict(p)
        for m in p:
            factor = tuple(pair for pair in m if pair[1] > 1 or pair[0] not in row)
            if len(factor) == len(m) - 1 and all(is_unit(v) for v, _ in factor):
                (v,) = (pair[0] for pair in m if pair not in factor)
                row[v][factor] = rest.pop(m)
        need(not atoms.inputs(left := Poly(rest)) & set(own), "a function that is not affine", UNCHECKED)
        A.append([plain(Poly(row[v])) for v in own])
        b.append(left)
    return A, b


def is_bowl(p: Poly, own: Iterable[int], atoms: Atoms) -> bool:
    """Whether p, a quadratic in the variables ``own``, is convex."""
    return psd([[plain(slope(slope(p, i, atoms), j, atoms)) for j in own] for i in own])


def convex(p: Poly, own: Sequence[int], atoms: Atoms) -> bool:
    """Whether p is convex in the inputs ``own``, at all values that the others can have, wherever p is defined: a sum of convex
    terms with weights >= 0 (see ``bends``) and of a convex quadratic. With units: it is so at all corners.
    """
    if any(is_unit(v) for m in p for v, _ in m):
        return all(convex(q, own, atoms) for q in at_corners(p))
    rest = {}
    for m, a in p.items():
        inner = [(v, n) for v, n in m if atoms.feels(v, own)]
        if inner and all(v in own for v, _ in m) and sum(n for _, n in m) <= 2:
            rest[m] = a
        elif inner and not (len(m) == 1 and a > 0 and bends(*inner[0], own, atoms)):
            return False
    return is_bowl(Poly(rest), own, atoms)


def bends(v: int, n: int, own: Sequence[int], atoms: Atoms) -> bool:
    """Whether v^n is convex, n >= 1.
    An even power of an input, or any of one that is >= 0. Of atoms: the norm of an affine map; exp or max of convex ones; u^k, k
    > 1, of a convex u >= 0; and powers of these where they are >= 0.
    """
    if v in own:
        return n % 2 == 0 or v in atoms.nonnegative
    op, u, *more = atoms.meaning[v]
    if n > 1 and not positive(variable(v), atoms):
        return False
    if op == "pow" and more[0] == HALF and all(sum(n for _, n in m) <= 2 for m in u):  # z^2 u(x/z) is psd, z the variable -1.
        form = Poly({(*[(-1, 2 - k)] * (k < 2), *m): a for m, a in u.items() for k in [sum(n for _, n in m)]})
        straight = not any(w in atoms.meaning and atoms.feels(w, own) for m in u for w, _ in m)
        return straight and is_bowl(form, sorted({v for m in form for v, _ in m}), Atoms())
    powers = op == "pow" and more[0] > 1 and positive(u, atoms)
    return (powers or op in ("fmax", "exp")) and all(convex(part, own, atoms) for part in (u, *more) if isinstance(part, Poly))


def positive(p: Poly, atoms: Atoms) -> bool:
    """Whether all terms are >= 0 wherever they are defined: even powers, and inputs and atoms that are >= 0."""

    def is_nonnegative(v: int) -> bool:
        op, u, *more = atoms.meaning.get(v, ("in", None))
        if op == "fmax":
            return u == -more[0] or positive(u, atoms) or positive(more[0], atoms)
        return v in atoms.nonnegative or is_unit(v) or op == "exp" or (op == "pow" and more[0].denominator > 1)

    return all(a >= 0 and all(n % 2 == 0 or is_nonnegative(v) for v, n in m) for m, a in p.items())


def nonnegative(p: Poly, hint: Any, atoms: Atoms) -> bool:
    """Whether p is a sum of squares, those of the hint, and of terms >= 0; with units: it is so at all corners."""
    found = at_corners(p)
    hints = entries(hint["corners"], len(found)) if "corners" in entries(hint, kind=dict) else [hint] * len(found)
    return all(positive(q + -squares(part), atoms) for q, part in zip(found, hints, strict=True))


def defined(program: VerifierProgram, box: Box) -> bool:
    """True where each step is defined for all values of the parameters, and of the inputs of which the box has no intervals;
    raises else. The polynomials alone do not see a 0/0 that cancels.
    """
    return len(jets(program, [*box, *[ALL] * (program.n - len(box))], 0)) == len(program.outputs)


class VerifierStatement:
    """A statement of a certificate: its id, its numbers, the box that it speaks of, and the hints of its proof.
    The numbers are those that the hypothesis has, no others, all finite. The box gives intervals for names of inputs, and for t;
    all other inputs may have any value. It is said for all values of the parameters between their ends, all finite.
    """

    def __init__(self, data: Any, id: str) -> None:
        self.id, value, names = id, entries(field(data, "value"), kind=dict), NUMBERS.get(id, ())
        need(set(names) <= set(value) <= {*names, *OPTIONAL.get(id, ())}, "a number is missing, or one has no place here")
        self.value = {name: number(value[name]) for name in value}
        scope = field(data, "scope", dict)
        need(set(scope) <= {"states", "time", "parameters"}, "another scope")
        states, ranges = (field(scope, part, dict) for part in ("states", "parameters"))
        ends = {**states, "t": scope["time"]} if scope.get("time") is not None else states
        self.box = {name: VerifierInterval(*vector(pair, 2, infinite=True)) for name, pair in ends.items()}
        self.ranges = {name: vector(pair, 2) for name, pair in ranges.items()}
        need(all(low <= high for low, high in self.ranges.values()), "the interval of a parameter is empty")
        self.parameters = {name: between(k, *self.ranges[name]) for k, name in enumerate(self.ranges)}
        self.proof = field(data, "proof", dict)

    def intervals(self, names: Sequence[str], *programs: VerifierProgram) -> Box:
        """The box of some inputs and of the programs' parameters; 0 for those at which no step of these looks."""
        used = {program.inputs[k] for program in programs for k in program.used}
        box = {name: self.box.get(name, ALL) for name in names}
        box |= {name: span(p) for program in programs for name, p in program.parameters.items()}
        return [x if name in used else VerifierInterval(ZERO) for name, x in box.items()]

    def where(self, names: Sequence[str]) -> str:
        """For all values of some inputs, in words."""
        boxed = ", ".join(f"{escaped(name)} in {self.box[name]}" for name in names if name in self.box)
        rest = [escaped(name) for name in names if name not in self.box]
        every = f"for all {', '.join(rest) if len(rest) <= 6 else f'{rest[0]}, ..., {rest[-1]}'}" if rest else "for all values"
        return f"{every} with {boxed}" if boxed else every

    def for_parameters(self) -> str:
        """For which parameters."""
        ranges = (f"{escaped(name)} in [{written(low, UP)}, {written(high, DOWN)}]" for name, (low, high) in self.ranges.items())
        return "".join(f"; for every {one}" for one in ranges)


class VerifierModel:
    """The data of a model. ``inputs`` are those of the function that is named first but for the parameters, ``n`` their number;
    states are among them. Each of its functions has all parameters, and a number may be a function of these alone.
    """

    name, first = "", ""

    def __init__(self, data: Any, parameters: Parameters) -> None:
        need(field(data, "class") == self.name, "a hypothesis of another class of models")
        need(names_of(data.get("parameters", [])) == list(parameters), "the scope has other parameters")
        self.data, self.parameters = data, parameters
        inputs = names_of(field(field(data, self.first), "inputs"))
        self.inputs = inputs[: len(inputs) - len(parameters)]
        self.n = len(self.inputs)

    def program(self, name: str, outputs: int | None = None) -> VerifierProgram:
        """A function of ``inputs``."""
        return VerifierProgram(field(self.data, name), self.inputs, outputs, self.parameters)

    def intervals(self, count: int) -> list[tuple[Any, Any]]:
        """The ends of so many intervals, whose product is the law's set K; none is empty."""
        found: list[tuple[Any, Any]] = []
        for block in entries(field(self.data, "law")):
            need(field(block, "kind") == "box", "a law that is no box", UNCHECKED)
            found += zip(*(vector(field(block, end), None, self.parameters, True) for end in ("lower", "upper")), strict=True)
        need(len(found) == count, "the law has another size")
        need(all(gap(*pair) >= 0 and pair[0] != INF and pair[1] != -INF for pair in found), "an interval of the law is empty")
        return found


def on_cover(g: VerifierProgram, s: VerifierStatement, tree: Any, order: int, leaf: Leaf, smooth: bool = False) -> bool:
    """Whether ``leaf(jets)`` holds on each part of the scope's box."""
    return cover(tree, s.intervals(g.own, g), lambda part, _: leaf(jets(g, part, order, None, smooth)))


def inside(program: VerifierProgram, point: Sequence[Q], strictly: bool = True) -> bool:
    """Whether all rows are > 0 (or >= 0) at a point."""
    rows = jets(program, [VerifierInterval(x) for x in point], 0)
    return all(row.v.lo > 0 or (not strictly and row.v.lo == 0) for row in rows)


def concave_rows(program: VerifierProgram) -> bool:
    """Whether all rows are defined and concave everywhere, by the rules: then {rows >= 0} is closed and convex."""
    n, atoms = list(range(program.n)), Atoms()
    return defined(program, []) and all(convex(-p, n, atoms) for p in atoms.read(program))


def curved(program: VerifierProgram, s: VerifierStatement, hint: dict[str, Any], first: int = 0) -> bool:
    """Whether a function is defined, and convex in its inputs from the first on; those before are times.
    A C2 function is convex on a convex set where its Hessian is psd, on parts that cover the box; or it is so by the rules.
    """
    if "cover" in hint:
        leaf = lambda found: interval_psd([row[first:] for row in found[0].H[first:]])  # noqa: E731
        return on_cover(program, s, hint["cover"], 2, leaf)
    always = lambda box, _: defined(program, box[:first])  # noqa: E731
    by_rules = convex((atoms := Atoms()).read(program)[0], list(range(first, program.n)), atoms)
    return by_rules and cover(hint.get("time"), s.intervals(program.own[:first], program), always)


def slopes_below(program: VerifierProgram, s: VerifierStatement, P: Matrix, L: Q, factor: int = 1) -> bool:
    """Whether P J + J'P <= 2 L P, J ``factor`` times any (limit of) derivatives: of an affine function, else on a cover.
    Then factor <P(V(x) - V(y)), x - y> <= L <P(x - y), x - y> for the continuous V that is defined on the convex box.
    """
    n, atoms = range(len(P)), Atoms()
    if "cover" in s.proof:
        return on_cover(program, s, s.proof["cover"], 1, lambda j: form_below([[x * factor for x in y.g] for y in j], P, L))
    A, _ = affine(atoms.read(program), n, atoms)
    return defined(program, []) and symmetric_below([[factor * x for x in row] for row in A], P, L)


class NormForm:
    """A constraint g(t, q) = w |u| + offset(t), w > 0, u = y - Pi(y), y = A q + c(t), Pi the projection on 0, or on the points
    sum s_k e_k, e_k orthogonal, each s_k in an interval, or on a line: a segment, a box; |u| is the distance to that set.
    A distance d is convex, and off the set C1 with the gradient n = u/|u|, the derivatives of which lie between 0 and 1/d.
    """

    def __init__(self, g: VerifierProgram, hint: dict[str, Any]) -> None:
        own, atoms = list(range(1, g.n)), Atoms()
        self.g, self.time, self.w = g, hint.get("time"), number(field(hint, "w"), parameters=g.parameters)
        self.A = matrix(field(hint, "A"), None, len(own), g.parameters)
        parts = [*entries(field(hint, "c"), len(self.A)), field(hint, "offset")]
        *self.centre, self.offset = (VerifierProgram(part, ["t"], 1, g.parameters) for part in parts)
        self.b, self.reach = (number(hint.get(name, "0")) for name in ("b", "reach"))
        need(least(self.w) > 0, "w is not > 0")
        *c, offset = (atoms.read(part)[0] for part in [*self.centre, self.offset])
        u = [sum((variable(k) * x for k, x in zip(own, row, strict=True)), entry) for row, entry in zip(self.A, c, strict=True)]
        lines = [(vector(e, len(u)), vector(ends, 2, infinite=True)) for e, ends in field(hint, "clips", list)]
        need(all(dot(d, e) == 0 for k, (d, _) in enumerate(lines) for e, _ in lines[:k]), "lines that are not orthogonal")
        for e, ends in lines:
            along = self.clip(dot(e, u) * (1 / dot(e, e)), ends, atoms)
            u = [v + along * -x for v, x in zip(u, e, strict=True)]
        norms = [atoms.of("pow", sum((x * x for x in u), Poly({})), HALF), *(atoms.of("fmax", x, -x) for x in u if len(u) == 1)]
        need(atoms.read(g)[0] in [norm * self.w + offset for norm in norms], "g is not w |u| + offset")

    @staticmethod
    def clip(x: Poly, ends: list[Any], atoms: Atoms) -> Poly:
        """The nearest point to x of an interval: not below its low end and then not above the high one, or first this."""
        sign = 1 if ends[0] <= ends[1] else -1
        for end, up in zip(ends, (sign, -sign), strict=True):
            x = atoms.of("fmax", x * up, constant(end * up)) * up if abs(end) < INF else x
        return x

    def between(self, a: Q, b: Q) -> bool:
        """Whether a <= |w A'n| <= b for all n with |n| = 1, 0 <= a, 0 <= b."""
        AA = times([[x * self.w * self.w for x in row] for row in self.A], transpose(self.A))
        return b >= 0 and psd(plus(AA, eye(len(AA), a * a), -1)) and psd(plus(eye(len(AA), b * b), AA, -1))

    def in_time(self, s: VerifierStatement, leaf: Leaf) -> bool:
        """Whether g is defined for all q, and ``leaf(|c'|, offset', offset)`` holds, at all times of the scope."""

        def part(box: Box, _: Any) -> bool:
            *c, offset = (jets(p, box, 1)[0] for p in [*self.centre, self.offset])
            return defined(self.g, box[:1]) and leaf(length(j.g[0] for j in c), offset.g[0], offset.v)

        return cover(self.time, s.intervals(["t"], self.g), part)


class SweepingData(VerifierModel):
    """The model q' + N(Q(t), q) ∋ f(t, q), Q(t) = {q : g_i(t, q) >= 0 for all i}; g_i looks at t and some of the states.
    U_i is {g_i > -delta_i}, and the whole space where no delta is given. A row with ``members`` is a family: one g_i for each
    member, which lists the states and the numbers that g_i has as inputs behind t; these are proved as parameters, in any states.
    """

    name, first = "SweepingProcess", "f"

    def __init__(self, data: Any, parameters: Parameters) -> None:
        super().__init__(data, parameters)
        rows = [self.read_row(row) for row in entries(field(data, "constraints"))]
        self.gaps, self.members, self.deltas = [row[0] for row in rows], [row[1] for row in rows], [row[2] for row in rows]
        self.n -= 1
        need(all(p.own[:1] == ["t"] for p in self.gaps) and self.inputs[:1] == ["t"], "t is not the first input")

    def read_row(self, row: Any) -> tuple[VerifierProgram, list[tuple[list[str], list[Q]]], Q | None]:
        """The function g of a row, the states and numbers of each constraint that it stands for, and delta."""
        names, family, known = names_of(field(row, "numbers", list)), "members" in row, set(self.inputs)
        rows = field(row, "members", list)
        members = [(names_of(field(one, "states")), vector(field(one, "numbers"), len(names))) for one in rows]
        hulls = [(min(column), max(column)) for column in transpose([numbers for _, numbers in members])]
        units = {name: between(len(self.parameters) + k, *hulls[k]) for k, name in enumerate(names)}
        g = VerifierProgram(field(row, "graph"), None, 1, {**units, **self.parameters})
        members = members if family else [(g.own[1:], [])]
        need(not set(names) & set(self.parameters) and not (family and known & set(g.own[1:])), "a name of a family is known")
        need(members != [] and all(len(q) == g.n - 1 and set(q) <= known for q, _ in members), "a constraint has other states")
        return g, members, number(row["delta"]) if "delta" in row else None

    def where(self, s: VerifierStatement, local: bool = True) -> str:
        """For which t, q and i, and what the U_i are, in words."""
        ends = list(accumulate(map(len, self.members), initial=0))
        spans = [f"{a + 1}" if b == a + 1 else f"{a + 1}, ..., {b}" for a, b in pairwise(ends)]
        finite = [f"{written(d)} (i = {i})" for i, d in zip(spans, self.deltas, strict=True) if d is not None and local]
        deltas = f"; delta_i = {', '.join(finite[:8])}{', ...' * (len(finite) > 8)}" if finite else ""
        return f"{s.where(self.inputs)}, for each of {ends[-1]} i{deltas}"

    def each(self, s: VerifierStatement) -> Iterable[tuple[VerifierProgram, Q | None, dict[str, Any], NormForm | None]]:
        """Each g_i, its delta, the hint for it, and its form where that is a norm."""
        for g, delta, hint in zip(self.gaps, self.deltas, entries(field(s.proof, "constraints"), len(self.gaps)), strict=True):
            yield g, delta, hint, NormForm(g, hint) if hint.get("form") == "norm" else None

    def convex(self, s: VerifierStatement) -> str:
        """S-convex: each g_i(t, .) is convex on the box.
        Theorem: a norm of an affine function is convex, and the distance to a convex set. Premises: 1. g is defined; 2. it has
        this form (``NormForm`` compares polynomials, w > 0); 3. or it is defined and convex (``curved``).
        """
        for g, _, hint, form in self.each(s):  # 2
            if form is not None:
                need(form.in_time(s, lambda *_: True), "g is not defined")  # 1
            else:
                need(curved(g, s, hint, 1), "g is not convex by the rules, or a Hessian is not psd")  # 3
        return f"g_i(t, .) is convex {self.where(s, local=False)}"

    def regular(self, s: VerifierStatement) -> str:
        """A0 to A4, of each g_i on U_i = {g_i > -delta_i}.
        A0: all points nearer than c to {g_i >= 0} are in U_i: along the segment from a point with g_i >= 0 to such a point, g_i
        falls by less than b c, where |grad g_i| <= b on U_i. A1: a <= |grad g_i| <= b. A2: |d_t g_i| <= speed. A3: |d_t grad g_i|
        <= turn. A4: |D^2 g_i| <= M, and <= M_contact where g_i >= 0, wherever the gradient, which is continuous, has a
        derivative. Theorems: of a norm, with |w A| <= b and w |u| = g - offset > reach - delta on U, >= reach where g >= 0:
        grad g = w A'n, d_t g = w n.c' + offset', d_t grad g = w A'(1 - nn')c'/|u|, D^2 g = w A'(1 - nn')A/|u|, |n| = 1. Else:
        bounds on each part of a cover that U may meet, g having continuous derivatives of the order that is asked for there.
        Premises: 1. all numbers are >= 0, a > 0, and c > 0 where a delta is given; 2. delta > 0 where it is given (else U is the
        whole space). Norms: 3. u /= 0 on U: offset <= -reach < -delta at all times; 4. b is a bound; 5. A0: c b <= delta; A1: a^2
        <= w^2 A A' <= b^2; A2: w |c'| + |offset'| <= speed; A3: w b |c'| <= turn (reach - delta); A4: b^2 <= M (reach - delta),
        b^2 <= M_contact reach. Else: 6. the same on the part, of A0 with the |grad g| there for b.
        """
        a, b, c, speed, turn, M, near = (s.value.get(k, ZERO) for k in ("a", "b", "c", "speed", "turn", "M", "M_contact"))
        need(all(x > 0 or (x == 0 and name not in ("a", "c")) for name, x in s.value.items()), "a number is not > 0, or < 0")  # 1
        need(s.id != "A0" or c > 0 or all(delta is None for delta in self.deltas), "c is missing")  # 1

        def norm_bound(form: NormForm, delta: Q) -> bool:  # 5
            w, left = -least(-form.w), form.reach - delta
            return {
                "A0": lambda: c * form.b <= delta,
                "A1": lambda: form.between(a, b),
                "A2": lambda: form.in_time(s, lambda u, drift, _: end_product(w, u.hi) + max(-drift.lo, drift.hi) <= speed),
                "A3": lambda: form.in_time(s, lambda u, *_: end_product(w * form.b, u.hi) <= turn * left),
                "A4": lambda: form.b**2 <= M * left and form.b**2 <= near * form.reach,
            }[s.id]()

        def part_bound(g: VerifierJet, delta: Q | None) -> bool:  # 6
            size, H = length(g.g[1:]), [row[1:] for row in g.H[1:]]
            return (delta is not None and g.v.hi <= -delta) or {
                "A0": lambda: delta is None or end_product(c, size.hi) <= delta,
                "A1": lambda: a <= size.lo and size.hi <= b,
                "A2": lambda: max(-g.g[0].lo, g.g[0].hi) <= speed,
                "A3": lambda: length(g.H[0][1:]).hi <= turn,
                "A4": lambda: norm_below(H, M) and (g.v.hi < 0 or norm_below(H, near)),
            }[s.id]()

        for g, delta, hint, form in self.each(s):
            need(delta is None or delta > 0, "delta is not > 0")  # 2
            if form is None:
                order, leaf = 1 + (s.id in ("A3", "A4")), lambda j, d=delta: part_bound(j[0], d)
                need(on_cover(g, s, hint.get("cover"), order, leaf, True), "the bound fails on a part")  # 6
                continue
            need((delta or INF) < form.reach, "delta is missing, or not < reach")  # 3
            need(form.in_time(s, lambda rate, drift, offset, r=form.reach: offset.hi <= -r), "the offset is above -reach")  # 3
            need(form.between(ZERO, form.b), "b is no bound of the gradient")  # 4
            need(norm_bound(form, delta or ZERO), "the bound fails")  # 5
        said = {
            "A0": f"every point nearer than {written(c, DOWN)} to one with g_i >= 0 is in" if c else "all points are in",
            "A1": f"{written(a, DOWN)} <= |grad_q g_i| <= {written(b, UP)} on",
            "A2": f"|d_t g_i| <= {written(speed, UP)} on",
            "A3": f"|d_t grad_q g_i| <= {written(turn, UP)} on",
            "A4": f"|D_q^2 g_i| <= {written(M, UP)}, and <= {written(near, UP)} where g_i >= 0, on",
        }[s.id]
        return f"{said} U_i = {{g_i > -delta_i}} (without a delta_i the whole space) {self.where(s)}"

    def qualified(self, s: VerifierStatement) -> str:
        """A5, A5': sum l_i |grad g_i| <= gamma |sum l_i grad g_i| for all l >= 0 and q in Q(t), over the i with g_i <= rho.
        Theorem: it is so where a d, not 0, has <grad g_i, d> >= |grad g_i| |d| / gamma for these i: multiply by l_i, add, and
        divide by |d|. Where one i is near it is true with gamma = 1. Premises: 1. gamma >= 1; 2. A5: rho > 0, without it all i;
        A5': rho = 0; 3. on each part that Q(t) may meet d is not 0, 4. and the inequality holds for all i that may be near.
        """
        gamma, rho, gaps = s.value["gamma"], s.value.get("rho", INF if s.id == "A5" else ZERO), self.gaps
        need(all(g.own[1:] == q for g, ((q, _), *_) in zip(gaps, self.members, strict=True)), "families", UNCHECKED)
        need(gamma >= 1, "gamma < 1")  # 1
        need(s.id == "A5'" or rho > 0, "rho is not > 0")  # 2

        def leaf(box: Box, hint: Any) -> bool:
            own = dict(zip([*self.inputs, *self.parameters], box, strict=True))
            found = [(g.own[1:], jets(g, [own[v] for v in g.inputs], 1)[0]) for g in gaps]
            near = [(names, g.g[1:]) for names, g in found if g.v.lo <= rho]
            if len(near) <= 1 or any(g.v.hi < 0 for _, g in found):
                return True
            d = dict(zip(self.inputs[1:], vector(hint, self.n), strict=True))
            along = [sum((x * d[v] for v, x in zip(*pair, strict=True)), VerifierInterval(ZERO)).lo for pair in near]
            sizes = [(length(gradient) * length(map(VerifierInterval, d.values()))).hi for _, gradient in near]
            escapes = all(end_product(gamma, low) >= size for low, size in zip(along, sizes, strict=True))
            return any(d.values()) and escapes  # 3, 4

        if len(gaps) > 1:
            need(cover(field(s.proof, "cover"), s.intervals(self.inputs, *gaps), leaf), "gamma fails on a part")
        near = f"sum l_i |grad_q g_i| <= {written(gamma, UP)} |sum l_i grad_q g_i| for all l_i >= 0, over the i with g_i"
        bound = "<= 0" if s.id == "A5'" else f"<= {written(rho, DOWN)}" if "rho" in s.value else "<= any rho"
        return f"{near} {bound}, at every point with all g_j >= 0, {s.where(self.inputs)}"

    def velocity(self, s: VerifierStatement) -> str:
        """S-f: |f(t, q) - f(t, r)| <= K_f |q - r|, |f| <= L_f (1 + |q|); where L_t is given, |f(t, q) - f(s, q)| <= L_t |t - s|.
        Theorems: a continuous f is Lipschitz on a convex box with a bound of its (limits of) derivatives; f = A q + b(t) has |f|
        <= |b| + |A| |q|. Premises: 1. f is defined for all t, q of the box; 2. |A| or |D_q f| <= K_f; 3. |b| <= L_f and |A| <=
        L_f, or |f| <= L_f (1 + |q|) on each part; 4. |d_t f| <= L_t.
        """
        f, K, L, atoms, own = self.program("f", self.n), s.value["K_f"], s.value["L_f"], Atoms(), list(range(1, self.n + 1))

        def small(j: list[VerifierJet], far: Any) -> bool:
            rate = length(x.g[0] for x in j).hi
            return length(x.v for x in j).hi <= end_product(L, 1 + far) and rate <= s.value.get("L_t", rate)  # 3, 4

        def part(box: Box, _: Any) -> bool:
            j = jets(f, box, 1)  # 1
            return small(j, length(box[1 : self.n + 1]).lo) and norm_below([x.g[1:] for x in j], K)  # 2

        if "cover" not in s.proof:
            A = [[span(x) for x in row] for row in affine(atoms.read(f), own, atoms)[0]]
            need(norm_below(A, K), "K_f")  # 2
            need(norm_below(A, L), "L_f")  # 3
            zero = [VerifierInterval(ZERO)] * self.n
            leaf = lambda t, _: defined(f, t[:1]) and small(jets(f, [t[0], *zero, *t[1:]], 1, [0]), ZERO)  # noqa: E731
            need(cover(s.proof.get("time"), s.intervals(["t"], f), leaf), "f, L_f or L_t")  # 1
        else:
            need(cover(s.proof["cover"], s.intervals(self.inputs, f), part), "K_f, L_f or L_t")
        rate = f", |f(t, q) - f(s, q)| <= {written(s.value['L_t'], UP)} |t - s|" if "L_t" in s.value else ""
        bounds = f"|f(t, q) - f(t, r)| <= {written(K, UP)} |q - r|, |f(t, q)| <= {written(L, UP)} (1 + |q|){rate}"
        return f"{bounds}, f being defined, {s.where(self.inputs)}, the same of s and r"

    def start(self, s: VerifierStatement) -> str:
        """S-start: g_i(0, q_0) >= 0. Premises: 1. g is defined there: no operation on numbers raises; 2. it is >= 0."""
        q = dict(zip(self.inputs[1:], vector(field(self.data, "q0"), self.n, self.parameters), strict=True))
        for g, members in zip(self.gaps, self.members, strict=True):
            for names, numbers in members:
                point = [x + constant(ZERO) for x in (ZERO, *(q[name] for name in names), *numbers, *self.parameters.values())]
                (value,) = g.run(point, constant, Atoms().apply)  # 1
                need(least(value) >= 0, "g < 0 at the start, or too near to 0")  # 2
        start = ", ".join(written(x) if type(x) is Q else f"a number in {span(x)}" for x in list(q.values())[:100])
        return f"g_i(0, q_0) >= 0 for each of {sum(map(len, self.members))} i, q_0 = ({start}{', ...' * (self.n > 100)})"


class OscillatorData(VerifierModel):
    """The model x'' + dPhi(x') + damping x' + dg(x) ∋ 0, Phi(v) = sum theta_j(|H_j v|), g infinite but where all C_i(x) >= 0."""

    name, first = "FrictionOscillator", "g"

    def frictions(self) -> list[VerifierProgram]:
        """The friction of each element, of the speed."""
        return [VerifierProgram(part, ["s"], 1, self.parameters) for part in entries(field(self.data, "theta"))]

    def friction(self, s: VerifierStatement) -> str:
        """O-theta: each theta is C1, convex and nondecreasing on [0, inf), and the symmetric part of the damping is psd.
        Theorem: a convex C1 function with theta'(0) >= 0 is nondecreasing. Premises: 1. theta is defined and C1 for s >= 0; 2.
        theta'(0) >= 0; 3. it is convex for s >= 0: theta'' >= 0 on a cover, or by the rules; 4. the damping is psd.
        """
        line, frictions = [VerifierInterval(ZERO, INF), *map(span, self.parameters.values())], self.frictions()
        for theta, hint in zip(frictions, entries(field(s.proof, "theta"), len(frictions)), strict=True):
            smooth = lambda box, _, p=theta: len(jets(p, box, 1, smooth=True)) == 1  # noqa: E731
            need(cover(entries(hint, kind=dict).get("slope"), line, smooth), "theta'")  # 1
            need(jets(theta, [VerifierInterval(ZERO)], 1)[0].g[0].lo >= 0, "theta'(0) < 0")  # 2
            bent = lambda box, _, p=theta: jets(p, box)[0].H[0][0].lo >= 0  # noqa: E731
            by_rules = "cover" not in hint and convex((atoms := Atoms([0])).read(theta)[0], [0], atoms)
            need(by_rules or cover(field(hint, "cover"), line, bent), "theta'' < 0")  # 3
        damping = field(self.data, "damping")
        if damping != []:
            need(psd(matrix(damping, self.n, self.n, self.parameters)), "the damping is not psd")  # 4
        drag = "; the symmetric part of the damping is positive semidefinite" if damping != [] else ""
        return f"theta_j is C1, convex and nondecreasing on [0, inf), for each of {len(frictions)} j{drag}"

    def potential(self, s: VerifierStatement) -> str:
        """O-g: g is convex, g >= bound, and {C >= 0} is closed and convex with interior points.
        Theorem: concave finite rows are continuous, and where all are > 0 there is an interior point. Premises: 1. the rows are
        concave; 2. one point is inside; 3. g is convex, 4. defined everywhere, 5. and a sum of bound, squares and terms >= 0.
        """
        g, C, bound, atoms = self.program("g", 1), self.program("C"), s.value["lower bound of g"], Atoms()
        need(concave_rows(C), "a row is not concave by the rules")  # 1
        need(inside(C, vector(field(s.proof, "interior"), self.n)), "the point is not inside")  # 2
        need(curved(g, s, s.proof), "g is not convex")  # 3
        need(defined(g, []), "g is not defined")  # 4
        need(nonnegative(atoms.read(g)[0] + -bound, field(s.proof, "bound"), atoms), "inf g")  # 5
        whole = f"g is convex {s.where(self.inputs)}" if "cover" in s.proof else "g is convex"
        domain = "{x : C_i(x) >= 0} is closed and convex, and has interior points"
        return f"{whole}; g >= {written(bound, DOWN)} everywhere; {domain}"

    def dry(self, s: VerifierStatement) -> str:
        """O-dry: sum theta_j'(0) |H_j d| >= r |d| for all d.
        Theorem: a sum of numbers >= 0 is not below the root of the sum of their squares. Premises: 1. r > 0; 2. theta_j'(0) >= 0,
        theta_j being defined on [0, 2^-30]; 3. sum theta_j'(0)^2 H_j'H_j - r^2 is psd.
        """
        r, frictions = s.value["radius of A(0)"], self.frictions()
        need(r > 0, "r is not > 0")  # 1
        gram = eye(self.n, -r * r)
        for theta, entry in zip(frictions, entries(field(self.data, "H"), len(frictions)), strict=True):
            H, low = matrix(entry, None, self.n, self.parameters), jets(theta, [VerifierInterval(ZERO)], 1)[0].g[0].lo
            need(low >= 0 and defined(theta, [VerifierInterval(ZERO, Q(1, 2**30))]), "theta'(0) < 0, or no theta")  # 2
            gram = plus(gram, times(transpose(H), H), low * low)
        need(psd(gram), "the radius")  # 3
        return f"sum_j theta_j'(0) |H_j d| >= {written(r, DOWN)} |d| for all d"

    def steps_grow(self, s: VerifierStatement) -> str:
        """O-steps: the steps are > 0 and do not shrink. Premises: 1. the first is > 0; 2. each is >= the one before."""
        steps = vector(field(self.data, "steps"))
        need(steps[0] > 0 and all(a <= b for a, b in pairwise(steps)), "a step is not > 0, or shrinks")  # 1, 2
        return f"0 < h_1 <= h_2 <= ... of all {len(steps)} steps, from {written(steps[0])} to {written(steps[-1])}"


class FirstOrderData(VerifierModel):
    """The model M x' = f(t, x) + r, y = h(t, x, l), r = g(t, x, l), -y ∈ N_K(l); W = M - h (theta f_x + gamma g_x) of a step."""

    name, first = "FirstOrderSystem", "f"

    def __init__(self, data: Any, parameters: Parameters) -> None:
        super().__init__(data, parameters)
        self.n = len(entries(field(data, "x0")))
        self.m = len(self.inputs) - 1 - self.n
        need(self.inputs[:1] == ["t"], "t is not the first input")
        self.M, self.steps = matrix(field(data, "M"), self.n, self.n, parameters), vector(field(data, "steps"))
        self.theta, self.gamma = number(field(data, "theta")), number(field(data, "gamma"))
        need(all(step > 0 for step in self.steps), "a step is not > 0")

    def programs(self) -> list[VerifierProgram]:
        """The functions f, which looks at no multiplier, g and h."""
        f, g, h = self.program("f", self.n), self.program("g", self.n), self.program("h", self.m)
        need(not any(self.n < k < f.n for k in f.used), "f looks at a multiplier")
        return [f, g, h]

    def smooth(self, s: VerifierStatement) -> str:
        """F-jacobians: f, g and h are defined and C1, so that their Jacobians are those of the linearisation.
        Premise: 1. on parts that cover the box all operations have continuous derivatives, and no max may have a kink.
        """
        programs = self.programs()
        leaf = lambda box, _: all(len(jets(p, box, 1, smooth=True)) == len(p.outputs) for p in programs)  # noqa: E731
        need(cover(s.proof.get("cover"), s.intervals(self.inputs, *programs), leaf), "a derivative may jump")  # 1
        return f"f, g and h have continuous first derivatives {s.where(self.inputs)}"

    def step_bound(self, s: VerifierStatement) -> str:
        """F-step, F-W: M - s(theta f_x + gamma g_x) is regular for all 0 <= s <= h, and h is not below any step.
        Theorem: with a matrix R and J = theta f_x + gamma g_x, <v, R(M - s J) v> is affine in s; where it is > 0 for s = 0 and s
        = h and all v, not 0, no v has (M - s J) v = 0. Premises: 1. h > 0 is not below a step; 2. R M + M'R' > 0; 3. R(M - h J) +
        its transpose >= 2^-30 on parts that cover the box.
        """
        n, h, programs, R = self.n, s.value["h"], self.programs()[:2], matrix(field(s.proof, "R"), self.n, self.n)
        need(h >= max(self.steps) > 0, "h is below a step")  # 1
        RM = times(R, self.M) if n else []
        need(psd(RM, definite=True), "R M is not definite")  # 2

        def part(box: Box, _: Any) -> bool:
            F, G = ([j.g for j in jets(p, box, 1, range(1, n + 1))] for p in programs)
            J = [[F[i][k] * self.theta + G[i][k] * self.gamma for k in range(n)] for i in range(n)]
            RJ = [[sum((J[i][k] * row[i] for i in range(n)), VerifierInterval(ZERO)) for k in range(n)] for row in R]
            left = [[span(RM[a][b]) + RJ[a][b] * -h for b in range(n)] for a in range(n)]
            return interval_psd([[left[a][b] + left[b][a] + span(Q(-(a == b), 2**30)) for b in range(n)] for a in range(n)])  # 3

        need(cover(field(s.proof, "cover"), s.intervals(self.inputs, *programs), part), "the bound fails on a part")
        matrices = f"M - s({written(self.theta)} f_x + {written(self.gamma)} g_x) is regular for 0 <= s <= {written(h, DOWN)}"
        return f"{matrices} {s.where(self.inputs)}; no step is longer than {written(max(self.steps), UP)}"

    def complementarity(self, s: VerifierStatement) -> str:
        """F-mlcp, F-unique: W_mlcp = h gamma C W^-1 B + D is psd at each step; a step has one and only one next state.
        Theorem: -y in N_K(l), y = W_mlcp l + q, has one solution for every q where W_mlcp is definite, K closed, convex and not
        empty. Premises: 1. f = A x + ..., g = K x + B l + ..., h = C x + D l + ..., the rest in t alone; 2. all are defined at
        all times; 3. W has the inverse V/d, d > 0; 4. W_mlcp, times d, is psd; F-unique: 5. K is so; 6. W_mlcp is definite.
        """
        n, both, programs, atoms = self.n, range(1, self.n + self.m + 1), self.programs(), Atoms()
        found = [affine(atoms.read(p), both, atoms)[0] for p in programs]  # 1
        (A, _), (K, B), (C, D) = ([[row[:n] for row in rows], [row[n:] for row in rows]] for rows in found)
        leaf = lambda t, _: all(defined(p, t[:1]) for p in programs)  # noqa: E731
        need(cover(s.proof.get("time"), s.intervals(["t"], *programs), leaf), "f, g or h is not defined")  # 2
        unique = s.id == "F-unique"
        if unique:
            self.intervals(self.m)  # 5
        for step, entry in zip(self.steps, entries(field(s.proof, "inverses"), len(self.steps)), strict=True):
            W = plus(plus(self.M, A, -step * self.theta), K, -step * self.gamma)
            V, d = matrix(field(entry, "V"), n, n, self.parameters), number(field(entry, "d"), parameters=self.parameters)
            need(least(d) > 0 and (n == 0 or vanishes(plus(times(W, V), eye(n), -d))), "W has another inverse")  # 3
            W_mlcp = plus([[x * d for x in row] for row in D], times(times(C, V), B), step * self.gamma) if self.m else []
            need(psd(W_mlcp, definite=unique), "W_mlcp is not psd, or not definite", UNCHECKED)  # 4, 6
        steps = f"a step h of each of {len(self.steps)} lengths from {written(min(self.steps))} to {written(max(self.steps))}"
        if not unique:
            return f"W = M - h (theta f_x + gamma g_x) is regular, and h gamma C W^-1 B + D positive semidefinite, for {steps}"
        return f"from every state, at each time, {s.where(['t'])}, there is a solution with one next x only of {steps}"


class LureData(VerifierModel):
    """The model x' = A(x) + B l + f(t), y = C x + D l + e(t), -y ∈ N_K(l). Of a K that is a product of intervals Xi(z) is the
    indicator of K at -z, and Y(z) = <D z, z> + the recession function of Xi.
    """

    name, first = "LureSystem", "A"

    def __init__(self, data: Any, parameters: Parameters) -> None:
        super().__init__(data, parameters)
        self.m = len(entries(field(data, "D")))
        self.B = matrix(field(data, "B"), self.n, self.m, parameters)
        self.C = matrix(field(data, "C"), self.m, self.n, parameters)
        self.D = matrix(data["D"], self.m, self.m, parameters)
        self.e = data.get("e", ["0"] * self.m)

    def is_wide(self) -> bool:
        """Whether dom Y* is the whole space, and R(D + dXi) too: K is bounded (Xi grows faster than linear functions, and a
        continuous map on K solves its variational inequality), or D + D' > 0 (D + N_K is strongly monotone).
        """
        return all(gap(*pair) < INF for pair in self.intervals(self.m)) or psd(self.D, definite=True)

    def interior_of_law(self, s: VerifierStatement) -> str:
        """3.1: K has an interior point. Premise: 1. it is a product of intervals that have a length."""
        need(all(gap(*pair) > 0 for pair in self.intervals(self.m)), "K has no interior")  # 1
        return f"K, a product of {self.m} intervals, has interior points: Xi is continuous at one"

    def feedthrough(self, s: VerifierStatement) -> str:
        """4.1: <D z, z> >= least |z|^2, least >= 0. Premises: 1. least >= 0; 2. D - least is psd."""
        low = s.value["least"]
        need(low >= 0, "least < 0")  # 1
        need(psd(plus(self.D, eye(self.m, -low))), "D - least is not psd")  # 2
        return f"<D z, z> >= {written(low, DOWN)} |z|^2 for all z"

    def storage(self, s: VerifierStatement) -> str:
        """5.1: there is P = P' > 0 with P B = C'. Premises, of d P: 1. it is symmetric, 2. > 0; 3. d > 0, d P B = d C'."""
        P, d = (
            matrix(field(s.proof, "P"), self.n, self.n, self.parameters),
            number(s.proof.get("d", "1"), parameters=self.parameters),
        )
        need(P == transpose(P), "P is not symmetric")  # 1
        need(psd(P, definite=True), "P is not positive definite")  # 2
        need(least(d) > 0 and (self.m == 0 or vanishes(plus(times(P, self.B), transpose(self.C), -d))), "P B = C' fails")  # 3
        return "there is P = P' > 0 with P B = C'"

    def growth(self, s: VerifierStatement) -> str:
        """5.2: <P(A(x) - A(y)), x - y> <= omega <P(x - y), x - y>, with P = P' > 0 and P B = C'.
        Theorem: where it is so everywhere, R A(-R^-1 .) + omega, R^2 = P, is maximal monotone, as A is continuous. Premises: 1.
        those of ``storage``; 2. the inequality, and that A is defined (``slopes_below``).
        """
        known, omega, P = self.storage(s), s.value["omega"], matrix(s.proof["P"], self.n, self.n, self.parameters)  # 1
        need(slopes_below(self.program("A", self.n), s, P, omega), "omega")  # 2
        place = s.where(self.inputs) + ", the same of y" if "cover" in s.proof else "for all x, y"
        return f"{known}, and <P(A(x) - A(y)), x - y> <= {written(omega, UP)} <P(x - y), x - y> {place}"

    def domain_point(self, s: VerifierStatement, x: Sequence[Q]) -> None:
        """Show that C x + e = D'k + y + (D + D')v is in D'(int K) - int dom Y*. Premises: 1. D is psd; 2. k is inside K; 3. y > 0
        where only the lower end of l is finite, < 0 where only the upper one is, any number where both are: -y is in the interior
        of the polar of K's recession cone. Where neither is, that has no interior, and nothing is known.
        """
        k, v, e = (vector(item, self.m, self.parameters) for item in (field(s.proof, "k"), field(s.proof, "v"), self.e))
        need(psd(self.D), "D is not psd")  # 1
        D, kv = self.D, [a + b for a, b in zip(k, v, strict=True)]
        y = [dot(row, x) + c + -dot(one, v) + -dot(two, kv) for row, c, one, two in zip(self.C, e, D, transpose(D), strict=True)]
        for (low, high), inner, push in zip(self.intervals(self.m), k, y, strict=True):
            need(gap(low, inner) > 0 and gap(inner, high) > 0, "k is not inside K")  # 2
            need((low != -INF and (high != INF or least(push) > 0)) or (high != INF and least(-push) > 0), "y is not inside")  # 3

    def range_meets_domain(self, s: VerifierStatement) -> str:
        """5.4a, 5.x0, 5.4c: R(C) + e, or C x_0 + e, meets the set S = D'(rint dom dXi) - int dom Y*; R(D + dXi) and S have one
        hull. Theorems: where dom Y* is the whole space so is S; where R(D + dXi) is too, so are both affine hulls. Else, where D
        is psd, -S, which is open, is in R(D + dXi): both hulls are the whole space as soon as S has a point. Premises: 1. what is
        the whole space; 2. or a point of S (``domain_point``), of 5.4a one in R(C) + e, of 5.x0 C x_0 + e.
        """
        if not self.is_wide():  # 1
            x = vector(self.data["x0"] if s.id == "5.x0" else field(s.proof, "x"), self.n, self.parameters)
            self.domain_point(s, x)  # 2
        if s.id == "5.4c":
            return "D'(rint dom dXi) - int dom Y* and R(D + dXi) have the same affine hull, the whole space"
        return f"{'R(C) + e meets' if s.id == '5.4a' else 'C x_0 + e is in'} D'(rint dom dXi) - int dom Y*"

    def convex_ranges(self, s: VerifierStatement) -> str:
        """5.4b: dom dXi, which is K, and R(D + dXi) are convex.
        Theorems: the range is the whole space (``is_wide``); or D is psd: D + N_K is maximal monotone and its graph a union of
        finitely many polyhedra, so that its range is closed, and convex but for its relative boundary. Premise: 1. one of these.
        """
        need(self.is_wide() or psd(self.D), "a range", UNCHECKED)  # 1
        return "dom dXi and R(D + dXi) are convex"

    def at_rest(self, s: VerifierStatement) -> str:
        """7.1: x = 0, l = 0, y = 0 is at rest, and 0 is an admissible start.
        Premises: 1. A(0) = 0, exactly; 2. f = 0 at all times; 3. e = 0; 4. 0 is in K; 5. as of 5.x0, with x_0 = 0.
        """
        A, f = self.program("A", self.n), VerifierProgram(field(self.data, "f"), ["t"], self.n, self.parameters)
        need(all(x.v.lo == 0 == x.v.hi for x in jets(A, [VerifierInterval(ZERO)] * self.n, 0)), "A(0) is not 0")  # 1
        need(not any(Atoms().read(f)) and defined(f, s.intervals(["t"], f)), "f is not 0")  # 2
        need(not any(vector(self.e, self.m, self.parameters)), "e is not 0")  # 3
        need(all(gap(a, ZERO) >= 0 and gap(ZERO, b) >= 0 for a, b in self.intervals(self.m)), "0 is not in K")  # 4
        if not self.is_wide():
            self.domain_point(s, [ZERO] * self.n)  # 5
        return f"A(0) = 0, f(t) = 0 {s.where(['t'])}, e = 0, 0 is in K, and 0 is in D'(dom dXi) - int dom Y*"


class InclusionData(VerifierModel):
    """The model x' ∈ F(x) - S(x) - dphi(x) - N_C(x), without S or phi where there is none. C is {x : all its rows are >= 0}."""

    name, first = "MonotoneInclusion", "F"

    def where_given(self, name: str, outputs: int) -> VerifierProgram | None:
        """S or phi, where there is one."""
        return None if field(self.data, name) is None else self.program(name, outputs)

    def selection(self, atoms: Atoms) -> tuple[list[Poly], list[Switch]]:
        """V and the switches, F - S - dphi = V - sum w l a, phi a smooth function and w max(u, v) = w (u + v)/2 + w |u - v|/2.
        Premises: 1. all functions are defined everywhere; 2. w >= 0, and u - v is affine.
        """
        F, S, phi = self.program("F", self.n), self.where_given("S", self.n), self.where_given("phi", 1)
        need(all(defined(p, []) for p in (F, S, phi) if p is not None), "F - S is not defined")  # 1
        V, switches = atoms.read(F), []
        if S is not None:
            V = [v + -p for v, p in zip(V, atoms.read(S), strict=True)]
        if phi is None:
            return V, switches
        potential, kinks = atoms.read(phi), [v for v, (op, *_) in atoms.meaning.items() if op == "fmax"]
        (weights,), (rest,) = affine(potential, kinks, atoms)
        for v, w in zip(kinks, weights, strict=True):
            _, one, other = atoms.meaning[v]
            if w:
                (row,), (c,) = affine([one + -other], range(self.n), atoms)  # 2
                need(least(w) >= 0, "phi is not convex")  # 2
                switches.append((w * HALF, row, plain(c)))
                rest = rest + (one + other) * (w * HALF)
        return [v + -slope(rest, i, atoms) for i, v in enumerate(V)], switches

    def monotone(self, s: VerifierStatement) -> str:
        """M-T: S + dphi is monotone; where no box is needed, maximal monotone.
        Theorems: so is the subdifferential of a finite convex function; a continuous S that is monotone everywhere is maximal;
        sums of maximal monotone operators that are defined everywhere are. Premises: 1. phi is convex and defined (``curved``);
        2. S is defined and monotone (``slopes_below``).
        """
        S, phi, hint = self.where_given("S", self.n), self.where_given("phi", 1), field(s.proof, "phi", dict)
        local = "cover" in {**s.proof, **hint} and bool(s.box)
        if phi is not None:
            need(curved(phi, s, hint), "phi is not convex")  # 1
        if S is not None:
            need(slopes_below(S, s, eye(self.n), ZERO, -1), "S is not monotone")  # 2
        return f"S + dphi is {'' if local else 'maximal '}monotone {s.where(self.inputs) if local else 'for all x'}"

    def set_with_interior(self, s: VerifierStatement) -> str:
        """M-C: C is closed and convex, with an interior point. Premises: 1. its rows are concave; 2. all are > 0 at a point."""
        C, point = self.program("C"), vector(field(s.proof, "interior"), self.n)
        need(concave_rows(C) and inside(C, point), "a row is not concave by the rules, or the point not inside")  # 1, 2
        return f"C, of {len(C.outputs)} rows, is closed and convex, and has interior points"

    def continuous(self, s: VerifierStatement) -> str:
        """M-A1: F is continuous. Premise: 1. it is defined on parts that cover the box: all operations are continuous there."""
        need(on_cover(self.program("F", self.n), s, s.proof.get("cover"), 0, lambda found: True), "F is not defined")  # 1
        return f"F is defined and continuous {s.where(self.inputs)}"

    def linear_growth(self, s: VerifierStatement) -> str:
        """M-A2: |v| <= a_1 + a_2 |x| for all x and v ∈ F(x) - S(x) - dphi(x).
        Theorem: v = A x + b - sum w l a, |l| <= 1, and |b - sum w l a| is largest at l = +-1. Premises: 1. F - S - dphi has this
        form; 2. |A| <= a_2; 3. |b - sum w l a| <= a_1 at all corners, a_1 >= 0.
        """
        V, switches = self.selection(atoms := Atoms())
        A, b = affine(V, range(self.n), atoms)  # 1
        a_1, a_2 = s.value["a_1"], s.value["a_2"]
        spend(2000 * 2 ** len(switches))
        need(norm_below([[span(x) for x in row] for row in A], a_2), "a_2")  # 2
        for signs in product((-1, 1), repeat=len(switches)):
            v = [x + sum(e * w * a[i] for e, (w, a, _) in zip(signs, switches, strict=True)) for i, x in enumerate(b)]
            need(a_1 >= 0 and least(a_1 * a_1 + -dot(v, v)) >= 0, "a_1")  # 3
        return f"|v| <= {written(a_1, UP)} + {written(a_2, UP)} |x| for all x and all v in F(x) - S(x) - dphi(x)"

    def on_differences(self, s: VerifierStatement) -> str:
        """M-24: <v - w, x - y> <= L |x - y|^2 for all x, y in C, v ∈ F(x) - S(x) - dphi(x), w ∈ F(y) - S(y) - dphi(y).
        Theorems: what switches add is monotone, so that they only help; of the rest it is J + J' <= 2 L, of the matrix of an
        affine function, or of all (limits of) derivatives J on a convex set. Premises: 1. F - S - dphi has this form; 2. the
        inequality for the matrix; 3. or for F - S on each part that C may meet, 4. C and phi being convex.
        """
        L, atoms, F, C = s.value["L"], Atoms(), self.program("F", self.n), self.program("C")
        tail = f"{written(L, UP)} |x - y|^2 for v in F(x) - S(x) - dphi(x), w in F(y) - S(y) - dphi(y)"
        if "cover" not in s.proof:
            need(symmetric_below(affine(self.selection(atoms)[0], range(self.n), atoms)[0], eye(self.n), L), "L")  # 1, 2
            return f"<v - w, x - y> <= {tail}, for all x, y"
        need(concave_rows(C), "a row of C is not concave by the rules")  # 4
        S, phi = self.where_given("S", self.n), self.where_given("phi", 1)
        need(phi is None or curved(phi, s, field(s.proof, "phi", dict)), "phi is not convex")  # 4

        def part(box: Box, _: Any) -> bool:
            J, minus = ([j.g for j in jets(p, box, 1)] if p is not None else [] for p in (F, S))
            J = plus(J, minus, -UNIT) if minus else J
            return any(g.v.hi < 0 for g in jets(C, box, 0)) or form_below(J, eye(self.n), L)  # 3

        programs = [p for p in (F, S, C) if p is not None]
        need(cover(s.proof["cover"], s.intervals(self.inputs, *programs), part), "L")
        return f"<v - w, x - y> <= {tail}, for x and y in C, {s.where(self.inputs)}, the same of y"

    def dissipation(self, value: dict[str, Q], atoms: Atoms) -> Poly:
        """What beta - alpha |x|^2 - <x, v>, v ∈ F(x) - S(x) - dphi(x), is not below: -l a'x <= |c| for l ∈ Sgn(a'x + c)."""
        V, switches = self.selection(atoms)
        p = sum((w * -max(-least(c), -least(-c)) for w, _, c in switches), constant(value["beta"]))
        return sum((-(variable(i) * (v + variable(i, value["alpha"]))) for i, v in enumerate(V)), p)

    def dissipative(self, s: VerifierStatement) -> str:
        """M-A3: <x, w> <= -alpha |x|^2 + beta for all x in C and the projections w of v ∈ F(x) - S(x) - dphi(x) on the tangent
        cone of C. Theorem: w = v - n with n normal to C at x, <n, x> >= 0 as 0 is in C: it is left to show this of v.
        Premises: 1. C is closed and convex; 2. 0 is in C; 3. alpha > 0; 4. beta - alpha |x|^2 - <x, v> is a sum of squares and of
        terms >= 0.
        """
        C, alpha, beta = self.program("C"), s.value["alpha"], s.value["beta"]
        need(concave_rows(C), "a row is not concave by the rules")  # 1
        need(inside(C, [ZERO] * self.n, strictly=False), "0 is not in C")  # 2
        need(alpha > 0, "alpha is not > 0")  # 3
        need(nonnegative(self.dissipation(s.value, atoms := Atoms()), s.proof, atoms), "beta")  # 4
        bound = f"<x, w> <= -{written(alpha, DOWN)} |x|^2 + {written(beta, UP)} for all x in C"
        return f"{bound}, w the projection of any v in F(x) - S(x) - dphi(x) on the tangent cone of C"


STATEMENTS: dict[str, Callable[[Any, VerifierStatement], str]] = {
    **dict.fromkeys(("A0", "A1", "A2", "A3", "A4"), SweepingData.regular), "S-convex": SweepingData.convex,
    **dict.fromkeys(("A5", "A5'"), SweepingData.qualified), "S-f": SweepingData.velocity, "S-start": SweepingData.start,
    "O-theta": OscillatorData.friction, "O-g": OscillatorData.potential, "O-dry": OscillatorData.dry,
    "O-steps": OscillatorData.steps_grow, "F-jacobians": FirstOrderData.smooth,
    **dict.fromkeys(("F-step", "F-W"), FirstOrderData.step_bound),
    **dict.fromkeys(("F-mlcp", "F-unique"), FirstOrderData.complementarity),
    "3.1": LureData.interior_of_law, "4.1": LureData.feedthrough, "5.1": LureData.storage, "5.2": LureData.growth,
    **dict.fromkeys(("5.4a", "5.4c", "5.x0"), LureData.range_meets_domain), "5.4b": LureData.convex_ranges,
    "7.1": LureData.at_rest, "M-T": InclusionData.monotone, "M-C": InclusionData.set_with_interior,
    "M-A1": InclusionData.continuous, "M-A2": InclusionData.linear_growth, "M-A3": InclusionData.dissipative,
    "M-24": InclusionData.on_differences,
}  # fmt: skip
NUMBERS = {  # Those that a statement has; all others have none.
    "A1": ("a", "b"), "A2": ("speed",), "A3": ("turn",), "A4": ("M", "M_contact"), "A5": ("gamma",), "A5'": ("gamma",),
    "S-f": ("K_f", "L_f"), "O-g": ("lower bound of g",), "O-dry": ("radius of A(0)",), "F-step": ("h",), "F-W": ("h",),
    "4.1": ("least",), "5.2": ("omega",), "M-A2": ("a_1", "a_2"), "M-A3": ("alpha", "beta"), "M-24": ("L",),
}  # fmt: skip
OPTIONAL = {"A0": ("c",), "A5": ("rho",), "S-f": ("L_t",)}


def answer(model: Any, statement: Any) -> tuple[str, str]:
    """Prove a statement of a model anew: "yes" and the sentence that was proved, "no" or "not checkable" and a reason."""
    Atoms.units.clear()
    SPENT[0] = 0
    try:
        id = field(statement, "id")
        need(type(id) is str and id in STATEMENTS, "no proof of this kind is known here", UNCHECKED)
        need(statement.get("proof") is not None, f"there is no proof: {escaped(statement.get('why'))}", UNCHECKED)
        rule, s = STATEMENTS[id], VerifierStatement(statement, id)
        (reader,) = (reader for reader in VerifierModel.__subclasses__() if rule in vars(reader).values())
        m = reader(model, s.parameters)
        need(set(s.box) <= {"t", *m.inputs}, "the scope has other inputs")
        return YES, rule(m, s) + s.for_parameters()
    except Unproved as reason:
        return reason.args[1], reason.args[0]
    except Exception as reason:  # Whatever else is wrong with a certificate.
        return NO, f"it is not well formed ({type(reason).__name__})"
    finally:
        SPENT[0] = -INF


def digest(model: Any) -> str:
    """The hash of a model's data."""
    return hashlib.sha256(json.dumps(model, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def read_certificate(path: str) -> dict[str, Any]:
    """The certificate of a file; no name may stand twice in an object."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        need(len({name for name, _ in pairs}) == len(pairs), "a name stands twice in an object")
        return dict(pairs)

    with open(path, encoding="utf-8") as file:
        certificate = json.load(file, object_pairs_hook=unique)
    need(field(certificate, "format") == FORMAT, f"its format is not {FORMAT}")
    return {**certificate, "model": field(certificate, "model", dict), "statements": field(certificate, "statements", list)}


def formulas(name: str, data: Any) -> list[str]:
    """A function of the model as this file reads it: its formulas, long parts left out; nothing where there is none to read."""
    try:
        program, nodes = VerifierProgram(data.get("graph", data), None, None, {}), []
    except Exception:
        return []
    for op, i, w in program.steps:
        u, v = nodes[i] if op not in ("in", "const") else "", nodes[w] if op in ("add", "mul", "fmax") else w
        forms = {"add": f"{u} + {v}", "mul": f"({u}) ({v})", "fmax": f"max({u}, {v})", "pow": f"({u})^({v})"}
        node = escaped(program.inputs[i]) if op == "in" else written(i) if op == "const" else forms.get(op, f"{op}({u})")
        nodes.append(node if len(node) <= 200 else "(...)")
    inputs, values = ", ".join(map(escaped, program.inputs)), ", ".join(nodes[k] for k in program.outputs)
    line = f"  {escaped(name)}({inputs}) = ({values})"
    return [line if len(line) <= 300 else line[:297] + "..."]


def main(path: str) -> int | str:
    """Print the model and the answer to each statement; 1 where one is "no", and a text where the file is not a certificate."""
    try:
        certificate = read_certificate(path)
        own = digest(certificate["model"])
    except (OSError, ValueError, TypeError, RecursionError, Unproved) as reason:
        return f"{path} is not a certificate: {reason.args[0] if type(reason) is Unproved else reason}"
    answers = [answer(certificate["model"], s) for s in certificate["statements"]]
    if own != certificate.get("hash"):
        answers = [(NO, "the data of the model do not have the hash of the certificate")] * len(answers)
    print(f"A {escaped(certificate['model'].get('class'))} that calls itself {escaped(certificate.get('title'))}; SHA-256 {own}")
    parts = [(name, data) for name, part in certificate["model"].items() for data in (part if type(part) is list else [part])]
    print(*[line for part in parts for line in formulas(*part)][:40], sep="\n")
    for s, (kind, sentence) in zip(certificate["statements"], answers, strict=True):
        id = s.get("id") if type(s) is dict else None
        print(f"{id if type(id) is str and id in STATEMENTS else escaped(id):<12} {kind}: {sentence}")
    kinds = [kind for kind, _ in answers]
    print(", ".join(f"{kinds.count(kind)} {kind}" for kind in (YES, NO, UNCHECKED)))
    return int(NO in kinds)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]) if len(sys.argv) == 2 else "usage: python verify.py certificate.json")
