"""Whether a statement of a certificate is false: a counterexample, found with 50 digits or exactly.

Nothing here is shared with ``verify.py``: programs are evaluated with dual numbers of mpmath at sampled points. ``find``
returns a text where the statement is certainly false, else "": where no counterexample is found it may be true or not.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import Any

import mpmath
from mpmath import mpf

DIGITS, TRIES, SLACK = 50, 40, mpf("1e-9")
Point = list[Any]


class Missing(Exception):
    """A function has no value at a point."""


def as_real(x: Any) -> Any:
    """A number of JSON as one of mpmath."""
    return mpf(x) if x in ("inf", "-inf") else mpf(Fraction(x).numerator) / Fraction(x).denominator


class Dual:
    """A value with its gradient."""

    def __init__(self, v: Any, g: list[Any]) -> None:
        self.v, self.g = v, g

    def apply(self, f: Any, d: Any) -> Dual:
        """f of it, d its derivative there; without gradient where there is none."""
        return Dual(f, [d * a if a else mpf(0) for a in self.g])


def power(u: Dual, n: Fraction) -> Dual:
    """u^n: of u < 0 for integers alone."""
    v, m = u.v, mpf(n.numerator) / n.denominator
    if (v < 0 and n.denominator > 1) or (v == 0 and n < 0):
        raise Missing
    if n.denominator == 1:
        f, d = v ** int(n), (m * v ** int(n - 1) if n >= 1 or v else mpf(0))
    else:
        f, d = v**m, (m * v ** (m - 1) if v or n > 1 else mpf("inf"))
    return u.apply(f, d)


SIMPLE: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    "exp": lambda x: (mpmath.exp(x), mpmath.exp(x)),
    "sin": lambda x: (mpmath.sin(x), mpmath.cos(x)),
    "cos": lambda x: (mpmath.cos(x), -mpmath.sin(x)),
    "tanh": lambda x: (mpmath.tanh(x), 1 - mpmath.tanh(x) ** 2),
    "atan": lambda x: (mpmath.atan(x), 1 / (1 + x * x)),
}


def nodes_of(program: Any, point: Point) -> list[Dual]:
    """All nodes of a program at a point."""
    n, found = len(point), []
    for op, i, *rest in program["steps"]:
        if op == "in":
            found.append(Dual(point[i], [mpf(int(k == i)) for k in range(n)]))
        elif op == "const":
            found.append(Dual(as_real(i), [mpf(0)] * n))
        elif op == "add":
            a, b = found[i], found[rest[0]]
            found.append(Dual(a.v + b.v, [x + y for x, y in zip(a.g, b.g, strict=True)]))
        elif op == "mul":
            a, b = found[i], found[rest[0]]
            found.append(Dual(a.v * b.v, [a.v * y + b.v * x for x, y in zip(a.g, b.g, strict=True)]))
        elif op == "fmax":
            found.append(found[i] if found[i].v >= found[rest[0]].v else found[rest[0]])
        elif op == "pow":
            found.append(power(found[i], Fraction(rest[0])))
        elif op == "log":
            if found[i].v <= 0:
                raise Missing
            found.append(found[i].apply(mpmath.log(found[i].v), 1 / found[i].v))
        else:
            found.append(found[i].apply(*SIMPLE[op](found[i].v)))
        if not mpmath.isfinite(found[-1].v) or abs(found[-1].v) > mpf("1e300"):
            raise OverflowError
    return found


def values(program: Any, point: Point) -> list[Dual]:
    """The values of a program."""
    nodes = nodes_of(program, point)
    return [nodes[k] for k in program["outputs"]]


def norm(v: Any) -> Any:
    """The length of a vector."""
    return mpmath.sqrt(sum((x * x for x in v), mpf(0)))


def dot(a: Any, b: Any) -> Any:
    """The scalar product."""
    return sum((x * y for x, y in zip(a, b, strict=True)), mpf(0))


def minus(a: Any, b: Any) -> list[Any]:
    """The difference of two vectors."""
    return [x - y for x, y in zip(a, b, strict=True)]


def real_matrix(rows: Any) -> mpmath.matrix:
    """A matrix of JSON."""
    return mpmath.matrix([[as_real(x) for x in row] for row in rows])


def least_eigenvalue(M: Any) -> Any:
    """Of the symmetric part."""
    return min(mpmath.eigsy((M + M.T) / 2, eigvals_only=True)) if M.rows else mpf(0)


class Sampler:
    """Points in the scope of a statement: ends, the model's own numbers, numbers of all sizes."""

    def __init__(self, model: Any, statement: Any, seed: int) -> None:
        scope = statement["scope"] or {}
        self.box = dict(scope.get("states") or {})
        if scope.get("time"):
            self.box["t"] = scope["time"]
        self.rng, self.own = random.Random(seed), [mpf(0), mpf(1), mpf(-1), mpf("0.5"), mpf(2), mpf(-2)]
        for part in _numbers(model):
            x = as_real(part)
            if mpmath.isfinite(x) and abs(x) < 1000:
                self.own += [x, -x]

    def number(self, low: Any = "-inf", high: Any = "inf") -> Any:
        """A number between."""
        low, high, rng = as_real(low), as_real(high), self.rng
        inner = [x for x in self.own if low <= x <= high]
        kind = rng.random()
        if inner and kind < 0.4:
            x = rng.choice(inner)
            return min(max(x + rng.choice([0, 0, mpf("1e-6"), -mpf("1e-6")]), low), high)
        if mpmath.isfinite(low) and mpmath.isfinite(high):
            return rng.choice([low, high]) if kind < 0.6 else low + (high - low) * mpf(rng.random())
        x = rng.choice([-1, 1]) * mpf(10) ** rng.uniform(-3, 1.5 if kind < 0.9 else 5)
        return min(max(x, low), high) if kind < 0.9 or low <= x <= high else low if mpmath.isfinite(low) else high

    def point(self, names: list[str]) -> Point:
        """A point for these inputs."""
        return [self.number(*self.box.get(name, ("-inf", "inf"))) for name in names]

    def near(self, point: Point, names: list[str]) -> Point:
        """A point in the scope near another."""
        size = mpf(10) ** self.rng.uniform(-6, 1)
        moved = [x + size * mpf(self.rng.gauss(0, 1)) * self.rng.choice([0, 1, 1]) for x in point]
        ends = [self.box.get(name, ("-inf", "inf")) for name in names]
        return [min(max(x, as_real(a)), as_real(b)) for x, (a, b) in zip(moved, ends, strict=True)]

    def pairs(self, names: list[str], fixed: int = 0) -> Iterator[tuple[Point, Point]]:
        """Pairs of points in the scope; the first ``fixed`` inputs are the same."""
        for _ in range(TRIES):
            a = self.point(names)
            b = self.near(a, names) if self.rng.random() < 0.5 else self.point(names)
            yield a, a[:fixed] + b[fixed:]


def _numbers(item: Any) -> Iterator[str]:
    if isinstance(item, dict | list):
        for part in item.values() if isinstance(item, dict) else item:
            yield from _numbers(part)
    elif isinstance(item, str):
        try:
            Fraction(item)
        except (ValueError, ZeroDivisionError):
            return
        yield item


def kink(program: Any, a: Point, b: Point) -> bool:
    """Whether a gradient jumps between two points: where the arguments of a max are equal."""
    for op, i, *rest in program["steps"]:
        if op != "fmax":
            continue

        def gap(at: Any, i: int = i, j: int = rest[0]) -> Any:
            nodes = nodes_of(program, [x + at * (y - x) for x, y in zip(a, b, strict=True)])
            return nodes[i].v - nodes[j].v

        low, high = mpf(0), mpf(1)
        if gap(low) * gap(high) >= 0:
            continue
        for _ in range(120):
            middle = (low + high) / 2
            low, high = (middle, high) if gap(middle) * gap(low) > 0 else (low, middle)
        width = mpf("1e-20")
        sides = [values(program, [x + at * (y - x) for x, y in zip(a, b, strict=True)]) for at in (low - width, high + width)]
        if any(norm(minus(u.g, v.g)) > mpf("1e-6") * (1 + norm(u.g)) for u, v in zip(*sides, strict=True)):
            return True
    return False


def not_convex(program: Any, sampler: Sampler, names: list[str], sign: int = 1, fixed: int = 0) -> str:
    """A chord below the function, or a point without value."""
    for a, b in sampler.pairs(names, fixed):
        middle = [(x + y) / 2 for x, y in zip(a, b, strict=True)]
        for low, high, at in zip(*(values(program, p) for p in (a, b, middle)), strict=True):
            if sign * (at.v - (low.v + high.v) / 2) > SLACK * (1 + abs(low.v) + abs(high.v)) * mpf("1e-15"):
                return f"a chord from {a} to {b}"
    return ""


def no_interior(program: Any) -> str:
    """Affine rows {>= 0} without interior points, by linear programming; rows that are not affine are not looked at."""
    from scipy.optimize import linprog

    n = len(program["inputs"])
    try:
        zero, other = values(program, [mpf(0)] * n), values(program, [mpf("1.7")] * n)
    except Missing:
        return ""
    rows = [a for a, b in zip(zero, other, strict=True) if a.g == b.g]
    if not rows:
        return ""
    A = [[*(-float(x) for x in row.g), max(1.0, float(norm(row.g)))] for row in rows]
    found = linprog([0.0] * n + [-1.0], A, [float(row.v) for row in rows], bounds=[(None, None)] * n + [(None, 1.0)])
    return "no interior point" if found.status == 2 or (found.status == 0 and -found.fun < 1e-12) else ""


def find(model: Any, statement: Any, seed: int = 0) -> str:
    """A counterexample in words; "" where none is found."""
    with mpmath.workdps(DIGITS):
        try:
            return FINDERS[statement["id"]](model, statement, Sampler(model, statement, seed))
        except Missing:
            return "a function has no value at a point of the scope"
        except OverflowError:
            return ""


# -- sweeping processes


def gaps_of(model: Any) -> list[tuple[Any, Any]]:
    """Programs of the constraints with their delta or None."""
    return [(row["graph"], as_real(row["delta"]) if "delta" in row else None) for row in model["constraints"]]


def s_convex(model: Any, statement: Any, sampler: Sampler) -> str:
    for g, _ in gaps_of(model):
        if found := not_convex(g, sampler, g["inputs"], fixed=1):
            return found
    return ""


def regular(model: Any, statement: Any, sampler: Sampler) -> str:
    id, value = statement["id"], {name: as_real(x) for name, x in statement["value"].items()}
    if any(x < 0 for x in value.values()) or value.get("a") == 0 or value.get("c") == 0:
        return "a number has the wrong sign"
    for g, delta in gaps_of(model):
        if delta is not None and delta <= 0:
            return "delta <= 0"
        for a, b in sampler.pairs(g["inputs"]):
            try:
                found = _irregular(id, value, g, delta, a, b, sampler)
            except Missing:
                if delta is None or id == "A0":
                    raise
                continue  # It may be no point of U.
            if found:
                return found
    return ""


def _irregular(id: str, value: Any, g: Any, delta: Any, a: Point, b: Point, sampler: Sampler) -> str:
    (at,) = values(g, a)
    size, names = norm(at.g[1:]), g["inputs"]
    if id == "A0":
        if delta is None:
            return ""
        if "c" not in value:
            return "a point out of U" if at.v <= -delta else ""
        # From the boundary of {g >= 0}, as steeply down as it goes.
        for _ in range(20):
            step = -at.v / size**2 if size else 0
            a = [a[0], *(x + step * d for x, d in zip(a[1:], at.g[1:], strict=True))]
            (at,) = values(g, a)
            size = norm(at.g[1:])
        ends = [sampler.box.get(name, ("-inf", "inf")) for name in names]
        if size == 0 or not all(as_real(low) <= x <= as_real(high) for x, (low, high) in zip(a, ends, strict=True)):
            return ""
        down = [a[0], *(x - (1 - SLACK) * value["c"] * d / size for x, d in zip(a[1:], at.g[1:], strict=True))]
        inside = all(as_real(low) <= x <= as_real(high) for x, (low, high) in zip(down, ends, strict=True))
        return f"{down} is near" if at.v >= -mpf("1e-30") and inside and values(g, down)[0].v <= -delta - SLACK else ""
    if delta is not None and at.v <= -delta:
        return ""
    if id == "A1":
        return f"|grad g| = {size} at {a}" if size < value["a"] * (1 - SLACK) or size > value["b"] * (1 + SLACK) else ""
    if id == "A2":
        return f"at {a}" if abs(at.g[0]) > value["speed"] * (1 + SLACK) + mpf("1e-30") else ""
    width = mpf("1e-20")
    shift = [mpf(0), *minus(b, a)[1:]] if id == "A4" else [mpf(1)] + [mpf(0)] * (len(a) - 1)
    length = norm(shift)
    if length == 0 or (sampler.box and any(name in sampler.box for name in names) and a == b):
        return ""
    (other,) = values(g, [x + width * d / length for x, d in zip(a, shift, strict=True)])
    rate = norm(minus(other.g[1:], at.g[1:])) / width
    if id == "A3":
        return f"turns at {rate} at {a}" if rate > value["turn"] * (1 + mpf("1e-6")) + mpf("1e-6") else ""
    bound = value["M_contact"] if at.v > 0 else value["M"]
    if rate > bound * (1 + mpf("1e-6")) + mpf("1e-6"):
        return f"curved by {rate} at {a}"
    return "a kink in U" if kink(g, a, b) and delta is None else ""


def qualified(model: Any, statement: Any, sampler: Sampler) -> str:
    gamma, gaps, names = as_real(statement["value"]["gamma"]), [g for g, _ in gaps_of(model)], model["f"]["inputs"]
    rho = as_real(statement["value"].get("rho", "0"))
    if gamma < 1 or (statement["id"] == "A5" and len(gaps) > 1 and rho <= 0):
        return "gamma < 1, or rho <= 0"
    rho = mpf(0) if statement["id"] == "A5'" else rho
    for a, _ in sampler.pairs(names):
        try:
            if found := opposed(gaps, names, a, gamma, rho, sampler):
                return found
        except Missing:
            continue  # It is no point of Q(t).
    return ""


def opposed(gaps: list[Any], names: list[str], a: Point, gamma: Any, rho: Any, sampler: Sampler) -> str:
    """Normals of two near constraints that oppose each other, on a way from a point towards points where two are near."""
    ends = [sampler.box.get(name, ("-inf", "inf")) for name in names]
    for _ in range(6):
        found = [values(g, [a[names.index(name)] for name in g["inputs"]])[0] for g in gaps]
        own = [dict(zip(g["inputs"], f.g, strict=True)) for g, f in zip(gaps, found, strict=True)]
        slopes = [[one.get(v, mpf(0)) for v in names[1:]] for one in own]
        near = [k for k, f in enumerate(found) if f.v <= max(rho, mpf("1e-40")) and norm(slopes[k])]
        if all(f.v >= -mpf("1e-40") for f in found):
            for i, j in itertools.combinations(near, 2):
                p, q = ([x / norm(slopes[k]) for x in slopes[k]] for k in (i, j))
                if norm([x + y for x, y in zip(p, q, strict=True)]) * gamma < 2 * (1 - SLACK):
                    return f"the normals of {i} and {j} at {a}"
        k = sampler.rng.randrange(len(gaps))
        if norm(slopes[k]):
            step = (min(max(found[k].v, mpf(0)), rho / 2) - found[k].v) / norm(slopes[k]) ** 2
            a = [a[0], *(x + step * d for x, d in zip(a[1:], slopes[k], strict=True))]
            a = [min(max(x, as_real(low)), as_real(high)) for x, (low, high) in zip(a, ends, strict=True)]
    return ""


def velocity(model: Any, statement: Any, sampler: Sampler) -> str:
    K, L = (as_real(statement["value"][name]) for name in ("K_f", "L_f"))
    rate = as_real(statement["value"].get("L_t", "inf"))
    for a, b in sampler.pairs(model["f"]["inputs"], 1):
        f, other = values(model["f"], a), values(model["f"], b)
        if norm(minus([x.v for x in f], [x.v for x in other])) > K * norm(minus(a, b)) * (1 + SLACK) + mpf("1e-30"):
            return f"K_f, from {a} to {b}"
        if norm([x.v for x in f]) > L * (1 + norm(a[1:])) * (1 + SLACK):
            return f"L_f at {a}"
        if norm([x.g[0] for x in f]) > rate * (1 + SLACK) + mpf("1e-30"):
            return f"L_t at {a}"
    return ""


def start(model: Any, statement: Any, sampler: Sampler) -> str:
    point = dict(zip(model["f"]["inputs"], [mpf(0), *map(as_real, model["q0"])], strict=True))
    low = [values(g, [point[name] for name in g["inputs"]])[0].v for g, _ in gaps_of(model)]
    return "g < 0" if any(x < 0 for x in low) else ""


# -- oscillators


def friction(model: Any, statement: Any, sampler: Sampler) -> str:
    for theta in model["theta"]:
        half = Sampler(model, {"scope": {"states": {theta["inputs"][0]: ["0", "inf"]}}}, sampler.rng.randrange(10**6))
        if values(theta, [mpf("1e-30")])[0].g[0] < -mpf("1e-25"):
            return "theta'(0) < 0"
        if found := not_convex(theta, half, theta["inputs"]):
            return found
        if any(kink(theta, a, b) for a, b in half.pairs(theta["inputs"])):
            return "a kink"
        for a, _ in half.pairs(theta["inputs"]):
            if a[0] > 0 and values(theta, a)[0].g[0] < -mpf("1e-30"):
                return "it falls"
    if model["damping"] and least_eigenvalue(real_matrix(model["damping"])) < -mpf("1e-30"):
        return "the damping is not psd"
    return ""


def potential(model: Any, statement: Any, sampler: Sampler) -> str:
    bound, whole = as_real(statement["value"]["lower bound of g"]), Sampler(model, {"scope": None}, sampler.rng.randrange(10**6))
    names = model["g"]["inputs"]
    if found := not_convex(model["g"], sampler, names) or not_convex(model["C"], whole, names, -1) or no_interior(model["C"]):
        return found
    for a, _ in whole.pairs(names):
        for _ in range(8):  # Down the slope.
            (g,) = values(model["g"], a)
            if g.v < bound - SLACK * (1 + abs(bound)):
                return f"g = {g.v} at {a}"
            step = mpf(10) ** sampler.rng.uniform(-3, 0)
            a = [x - step * d for x, d in zip(a, g.g, strict=True)]
    return ""


def dry(model: Any, statement: Any, sampler: Sampler) -> str:
    r, n = as_real(statement["value"]["radius of A(0)"]), len(model["g"]["inputs"])
    if r <= 0:
        return "r <= 0"
    slopes = [values(theta, [mpf("1e-30")])[0].g[0] for theta in model["theta"]]
    H = [[[as_real(x) for x in row] for row in rows] for rows in model["H"]]
    for k in range(4 * TRIES):
        d = [mpf(sampler.rng.gauss(0, 1)) for _ in range(n)] if k >= n else [mpf(int(i == k)) for i in range(n)]
        sigma = sum((f * norm([dot(row, d) for row in rows]) for f, rows in zip(slopes, H, strict=True)), mpf(0))
        if sigma < r * norm(d) * (1 - SLACK):
            return f"sigma in the direction {d}"
    return ""


def steps_grow(model: Any, statement: Any, sampler: Sampler) -> str:
    steps = [Fraction(x) for x in model["steps"]]
    return "" if steps and all(0 < a <= b for a, b in zip(steps, steps[1:] or steps, strict=False)) else "a step shrinks"


# -- first-order systems


def jacobians(model: Any, point: Point, whole: bool = True) -> dict[str, Any]:
    """A, B, C, D and K at a point; without the whole no C and D."""
    n, inputs = len(model["x0"]), len(model["f"]["inputs"])
    f, g = ([row.g for row in values(model[name], point)] for name in "fg")
    h = [row.g for row in values(model["h"], point)] if whole else []
    states, multipliers = range(1, n + 1), range(n + 1, inputs)
    parts = {
        "A": (f, states),
        "F": (f, multipliers),
        "K": (g, states),
        "B": (g, multipliers),
        "C": (h, states),
        "D": (h, multipliers),
    }
    return {name: mpmath.matrix([[row[k] for k in columns] for row in rows]) if rows and columns else None
            for name, (rows, columns) in parts.items()}  # fmt: skip


def smooth(model: Any, statement: Any, sampler: Sampler) -> str:
    names = model["f"]["inputs"]
    for a, b in sampler.pairs(names):
        for name in "fgh":
            if any(not mpmath.isfinite(x) for row in values(model[name], a) for x in row.g) or kink(model[name], a, b):
                return f"the derivative of {name} at {a}"
    return ""


def step_bound(model: Any, statement: Any, sampler: Sampler) -> str:
    h, M = as_real(statement["value"]["h"]), real_matrix(model["M"])
    steps = [as_real(x) for x in model["steps"]]
    if h <= 0 or max(steps) > h or min(steps) <= 0 or mpmath.det(M) == 0:
        return "h is below a step, or M is singular"
    for a, _ in sampler.pairs(model["f"]["inputs"]):
        J = jacobians(model, a, whole=False)
        X = as_real(model["theta"]) * J["A"] + as_real(model["gamma"]) * J["K"]
        if any(mpmath.det(M - h * k / 30 * X) * mpmath.det(M) <= 0 for k in range(31)):
            return f"singular at {a}"
    return ""


def mlcp(model: Any, statement: Any, sampler: Sampler) -> str:
    points = [a for a, _ in sampler.pairs(model["f"]["inputs"])]
    first = jacobians(model, points[0])
    for a in points:
        J = jacobians(model, a)
        if any(M is not None and mpmath.mnorm(M - first[name]) > SLACK for name, M in J.items()):
            return "the Jacobians vary"
    if first["F"] is not None and mpmath.mnorm(first["F"]) > 0:
        return "f looks at a multiplier"
    for step in map(as_real, model["steps"]):
        W = real_matrix(model["M"]) - step * (as_real(model["theta"]) * first["A"] + as_real(model["gamma"]) * first["K"])
        if step <= 0 or mpmath.det(W) == 0:
            return "W is singular"
        if first["D"] is None:
            continue
        full = step * as_real(model["gamma"]) * first["C"] * W**-1 * first["B"] + first["D"]
        if statement["id"] == "F-mlcp" and least_eigenvalue(full) < -SLACK:
            return "W_mlcp is not psd"
        if statement["id"] == "F-unique" and (found := not_unique(model, full, W**-1 * first["B"], first["C"], sampler)):
            return found
    return ""


def is_empty(law: Any) -> bool:
    """Whether a polyhedron {H l >= K} of a law is empty, by linear programming."""
    from scipy.optimize import linprog

    for block in law:
        if block["kind"] == "polyhedron":
            H, K = ([[-float(as_real(x)) for x in row] for row in block["H"]], [-float(as_real(x)) for x in block["K"]])
            if linprog([0.0] * block["size"], H, K, bounds=[(None, None)] * block["size"]).status == 2:
                return True
    return False


def not_unique(model: Any, W: Any, B: Any, C: Any, sampler: Sampler) -> str:
    """No solution, or two with different B l, of -y in N_K(l), y = W l + C z, K a box, by all index sets."""
    if is_empty(model["law"]):
        return "K is empty"
    if any(block["kind"] != "box" for block in model["law"]) or W.rows > 3:
        return ""
    ends = [tuple(map(as_real, pair)) for b in model["law"] for pair in zip(b["lower"], b["upper"], strict=True)]
    if any(low > high for low, high in ends):
        return "K is empty"
    m = W.rows
    for _ in range(12):
        q = C * mpmath.matrix([mpf(sampler.rng.gauss(0, 1)) * 10 ** sampler.rng.uniform(-1, 2) for _ in range(C.cols)])
        solutions = []
        for codes in itertools.product((-1, 0, 1), repeat=m):
            fixed = [low if code < 0 else high for code, (low, high) in zip(codes, ends, strict=True)]
            if any(code and not mpmath.isfinite(x) for code, x in zip(codes, fixed, strict=True)):
                continue
            free = [i for i in range(m) if not codes[i]]
            l = mpmath.matrix([mpf(0) if i in free else fixed[i] for i in range(m)])
            if free:
                part = mpmath.matrix([[W[i, j] for j in free] for i in free])
                if mpmath.det(part) == 0:
                    return ""
                right = mpmath.matrix([-(W * l + q)[i] for i in free])
                for i, x in zip(free, mpmath.lu_solve(part, right), strict=True):
                    l[i] = x
            y = W * l + q
            inside = all(low - SLACK <= l[i] <= high + SLACK for i, (low, high) in enumerate(ends))
            signs = all(
                (code < 0 and y[i] >= -SLACK) or (code > 0 and y[i] <= SLACK) or code == 0 for i, code in enumerate(codes)
            )
            if inside and signs:
                solutions.append(B * l)
        if not solutions:
            return "no solution"
        if any(mpmath.norm(a - b) > mpf("1e-4") for a, b in itertools.combinations(solutions, 2)):
            return "two solutions"
    return ""


# -- Lur'e systems


def law_ends(model: Any) -> list[tuple[Any, Any]] | None:
    """The ends of a law of intervals; None for others."""
    if model["phi"] is not None or any(block["kind"] != "box" for block in model["law"]):
        return None
    return [tuple(map(as_real, pair)) for b in model["law"] for pair in zip(b["lower"], b["upper"], strict=True)]


def thin_law(model: Any, statement: Any, sampler: Sampler) -> str:
    ends = law_ends(model)
    return "no interior" if ends is not None and any(low >= high for low, high in ends) else ""


def feedthrough(model: Any, statement: Any, sampler: Sampler) -> str:
    least = as_real(statement["value"]["least"])
    return "D" if least < 0 or least_eigenvalue(real_matrix(model["D"])) < least - SLACK * (1 + least) else ""


def exact(rows: Any) -> list[list[Fraction]]:
    """A matrix in fractions."""
    return [[Fraction(x) for x in row] for row in rows]


def rank(rows: list[list[Fraction]]) -> int:
    """The rank, by elimination."""
    rows, found = [list(row) for row in rows], 0
    for k in range(len(rows[0]) if rows else 0):
        pivot = next((row for row in rows[found:] if row[k]), None)
        if pivot is None:
            continue
        rows.remove(pivot)
        rows.insert(found, pivot)
        for i in range(found + 1, len(rows)):
            factor = rows[i][k] / pivot[k]
            rows[i] = [x - factor * y for x, y in zip(rows[i], pivot, strict=True)]
        found += 1
    return found


def no_storage(model: Any, statement: Any, sampler: Sampler) -> str:
    """There is P > 0 with P B = C' where C B is symmetric and psd, its rank is that of B, and that of [B; C'] too."""
    B, C = exact(model["B"]), exact(model["C"])
    m = len(C)
    CB = [[sum((x * row[k] for x, row in zip(line, B, strict=True)), Fraction(0)) for k in range(m)] for line in C]
    if any(CB[i][j] != CB[j][i] for i in range(m) for j in range(m)):
        return "C B is not symmetric"
    if m and least_eigenvalue(real_matrix([[str(x) for x in row] for row in CB])) < -SLACK:
        return "C B is not psd"
    both = [*B, *([C[k][i] for k in range(m)] for i in range(len(B)))]
    return "" if not m or rank(CB) == rank(B) == rank(both) else "no P"


def grows(model: Any, statement: Any, sampler: Sampler) -> str:
    if found := no_storage(model, statement, sampler):
        return found
    omega, P = as_real(statement["value"]["omega"]), real_matrix(statement["proof"]["P"])
    for a, b in sampler.pairs(model["A"]["inputs"]):
        f, other = values(model["A"], a), values(model["A"], b)
        J = mpmath.matrix([row.g for row in f])
        if all(mpmath.isfinite(x) for x in J) and max(mpmath.re(x) for x in mpmath.eig(J)[0]) > omega + SLACK * (1 + abs(omega)):
            return f"an eigenvalue at {a}"
        d, v = mpmath.matrix(minus(a, b)), mpmath.matrix(minus([x.v for x in f], [x.v for x in other]))
        if (v.T * P * d)[0] > omega * (d.T * P * d)[0] + SLACK * (1 + mpmath.norm(d)) * mpf("1e-10"):
            return f"from {a} to {b}"
    return ""


def one_range(model: Any, statement: Any, sampler: Sampler, x: Any = None) -> str:
    """5.4 and 5.x0 of one row, by cases; a potential that is not convex is no potential."""
    id = statement["id"]
    if model["phi"] is not None:
        if found := not_convex(
            model["phi"], Sampler(model, {"scope": None}, sampler.rng.randrange(10**6)), model["phi"]["inputs"]
        ):
            return found
    if is_empty(model["law"]) and id != "5.4b":
        return "K is empty"
    if len(model["D"]) != 1 or (ends := law_ends(model)) is None:
        return hull_of_quadratic(model) if id == "5.4c" and model["phi"] is not None and len(model["D"]) == 1 else ""
    ((low, high),), D, C = ends, as_real(model["D"][0][0]), [as_real(c) for c in model["C"][0]]
    if low > high:
        return "K is empty"
    if (mpmath.isfinite(low) and mpmath.isfinite(high)) or D > 0 or id == "5.4b" or isinstance(model.get("e"), dict):
        return ""
    if D < 0 or not (mpmath.isfinite(low) or mpmath.isfinite(high)):
        return "int dom Y* is empty"
    sign = 1 if mpmath.isfinite(low) else -1
    e = as_real(model["e"][0]) if "e" in model else mpf(0)
    x = x if x is not None else [as_real(v) for v in model["x0"]] if id == "5.x0" else None
    if x is None:
        return "" if id == "5.4c" or any(C) or sign * e > 0 else "C = 0"
    return "" if sign * (dot(C, x) + e) > 0 else "C x + e has the other sign"


def hull_of_quadratic(model: Any) -> str:
    """Of Phi = a y^2/2 + b y, a > 0, R(D + dXi) is a point for D = -1/a."""
    at = [values(model["phi"], [mpf(y)])[0].g[0] for y in (-3, 0, 1, 7)]
    a = at[2] - at[1]
    straight = abs(at[0] - at[1] + 3 * a) + abs(at[3] - at[1] - 7 * a) < SLACK
    return "R(D + dXi) is a point" if straight and a > 0 and abs(as_real(model["D"][0][0]) + 1 / a) < mpf("1e-40") else ""


def not_at_rest(model: Any, statement: Any, sampler: Sampler) -> str:
    if any(x.v != 0 for x in values(model["A"], [mpf(0)] * len(model["A"]["inputs"]))):
        return "A(0)"
    if any(x.v != 0 for a, _ in sampler.pairs(["t"]) for x in values(model["f"], a)):
        return "f"
    if any(Fraction(x) for x in model.get("e", [])):
        return "e"
    ends = law_ends(model)
    if ends is not None and not all(low <= 0 <= high for low, high in ends):
        return "0 is not in K"
    return one_range(model, statement, sampler, [mpf(0)] * len(model["x0"]))


# -- monotone inclusions


def operator(model: Any, x: Point) -> list[Any]:
    """S + the switches, or the gradient of phi; a sign of 0 is 0."""
    total = [mpf(0)] * len(x)
    if model["phi"] is not None:
        total = [a + b for a, b in zip(total, values(model["phi"], x)[0].g, strict=True)]
    if model["S"] is not None:
        total = [a + b.v for a, b in zip(total, values(model["S"], x), strict=True)]
    for weights, argument in model["switches"]:
        sign = mpmath.sign(values(argument, x)[0].v)
        total = [a + sign * as_real(w) for a, w in zip(total, weights, strict=True)]
    return total


def inside(model: Any, x: Point) -> Any:
    """The least row of C at x; infinite without rows, -1 where C has no value."""
    try:
        return min((row.v for row in values(model["C"], x)), default=mpf("inf"))
    except Missing:
        return mpf(-1)


def drift(model: Any, x: Point) -> list[Any]:
    """F - S."""
    return minus([row.v for row in values(model["F"], x)], operator(model, x))


def monotone(model: Any, statement: Any, sampler: Sampler) -> str:
    if model["phi"] is not None and (found := not_convex(model["phi"], sampler, model["phi"]["inputs"])):
        return found
    for a, b in sampler.pairs(model["F"]["inputs"]):
        d = minus(a, b)
        if dot(minus(operator(model, a), operator(model, b)), d) < -mpf("1e-20") * (1 + norm(d) ** 2):
            return f"from {a} to {b}"
    return ""


def bad_set(model: Any, statement: Any, sampler: Sampler) -> str:
    return not_convex(model["C"], sampler, model["C"]["inputs"], -1) or no_interior(model["C"])


def without_value(model: Any, statement: Any, sampler: Sampler) -> str:
    for a, _ in sampler.pairs(model["F"]["inputs"]):
        values(model["F"], a)
    return ""


def linear_growth(model: Any, statement: Any, sampler: Sampler) -> str:
    a_1, a_2 = (as_real(statement["value"][name]) for name in ("a_1", "a_2"))
    for a, _ in sampler.pairs(model["F"]["inputs"]):
        if norm(drift(model, a)) > (a_1 + a_2 * norm(a)) * (1 + SLACK) + mpf("1e-30"):
            return f"at {a}"
    return "a_1 < 0, or a_2" if a_1 < 0 or a_2 < 0 else ""


def one_sided(model: Any, statement: Any, sampler: Sampler) -> str:
    L = as_real(statement["value"]["L"])
    for a, b in sampler.pairs(model["F"]["inputs"]):
        d = minus(a, b)
        if inside(model, a) >= 0 and inside(model, b) >= 0:
            if dot(minus(drift(model, a), drift(model, b)), d) > (L + SLACK * (1 + abs(L))) * norm(d) ** 2 + mpf("1e-30"):
                return f"from {a} to {b}"
    return ""


def dissipative(model: Any, statement: Any, sampler: Sampler) -> str:
    alpha, beta = (as_real(statement["value"][name]) for name in ("alpha", "beta"))
    if alpha <= 0:
        return "alpha <= 0"
    for a, _ in sampler.pairs(model["F"]["inputs"]):
        if inside(model, a) > 0 and dot(a, drift(model, a)) > -alpha * norm(a) ** 2 + beta + SLACK * (
            1 + abs(beta) + norm(a) ** 2
        ):
            return f"at {a}"
    return not_convex(model["C"], sampler, model["C"]["inputs"], -1)


FINDERS: dict[str, Callable[[Any, Any, Sampler], str]] = {
    "S-convex": s_convex, **dict.fromkeys(("A0", "A1", "A2", "A3", "A4"), regular), "A5": qualified, "A5'": qualified,
    "S-f": velocity, "S-start": start, "O-theta": friction, "O-g": potential, "O-dry": dry, "O-steps": steps_grow,
    "F-jacobians": smooth, "F-step": step_bound, "F-W": step_bound, "F-mlcp": mlcp, "F-unique": mlcp, "3.1": thin_law,
    "4.1": feedthrough, "5.1": no_storage, "5.2": grows, **dict.fromkeys(("5.4a", "5.4b", "5.4c", "5.x0"), one_range),
    "7.1": not_at_rest, "M-T": monotone, "M-C": bad_set, "M-A1": without_value, "M-A2": linear_growth, "M-A3": dissipative,
    "M-24": one_sided,
}  # fmt: skip
