"""The first root of a polynomial in decimals, none before it missed."""

from __future__ import annotations

from decimal import Decimal

Series = list[Decimal]
NARROW = Decimal("1e-22")  # Of the interval: where neither bound decides, the polynomial touches 0.


def value(p: Series, s: Decimal) -> Decimal:
    total = p[-1]
    for c in reversed(p[:-1]):
        total = total * s + c
    return total


def about(p: Series, m: Decimal) -> Series:
    """Coefficients of the same polynomial in s - m."""
    q = p[:]
    for i in range(len(q) - 1):
        for j in range(len(q) - 2, i - 1, -1):
            q[j] += m * q[j + 1]
    return q


def first_root(p: Series, h: Decimal) -> Decimal | None:
    """Of a polynomial with p(0) > 0 the first root in (0, h]; None where it has none.

    On an interval m - r ... m + r the polynomial is within sum |q_k| r^k, k > 0, of q_0 = p(m), so it has no root, or its slope
    is within the like of q_1, so it has one exactly where the signs of its ends differ; else the interval is halved.
    """
    powers = [h**k for k in range(len(p))]
    if p[0] > sum(abs(c) * s for c, s in zip(p[1:], powers[1:], strict=True)):
        return None
    left = [(Decimal(0), h)]
    while left:
        a, b = left.pop()
        m, r = (a + b) / 2, (b - a) / 2
        q = about(p, m)
        terms, power = [], Decimal(1)
        for k in range(1, len(q)):
            terms.append(k * abs(q[k]) * power)  # Of the slope; r/k times it, of the value.
            power *= r
        if abs(q[0]) > r * sum(term / k for k, term in enumerate(terms, 1)):
            continue
        if abs(q[1]) > sum(terms[1:]):
            if value(q, r) <= 0:
                return m + _root(q, -r, r)
            continue
        if r < NARROW * h:
            return m + _middle(q, h)
        left += [(m, b), (a, m)]
    return None


def _middle(q: Series, h: Decimal) -> Decimal:
    """Of a polynomial that is near 0 about 0 where its root of order k is, as a root of its derivative of order k - 1."""
    sizes = [abs(c) * h**k for k, c in enumerate(q)]
    order = next(k for k, size in enumerate(sizes) if size > Decimal("1e-12") * max(sizes))
    for _ in range(order - 1):
        q = [k * c for k, c in enumerate(q)][1:]
    slope, s = [k * c for k, c in enumerate(q)][1:], Decimal(0)
    for _ in range(8):
        s -= value(q, s) / value(slope, s)
    return s


def _root(q: Series, low: Decimal, high: Decimal) -> Decimal:
    """Of a falling polynomial, q(low) > 0 >= q(high): Newton's method, halving where it leaves the bracket."""
    slope = [k * c for k, c in enumerate(q)][1:]
    s = (low + high) / 2
    for _ in range(400):
        v = value(q, s)
        low, high = (s, high) if v > 0 else (low, s)
        new = s - v / value(slope, s)
        new = new if low <= new <= high else (low + high) / 2
        if abs(new - s) <= Decimal("1e-58") * (abs(s) + abs(high - low)) or new == s:
            return new
        s = new
    return s
