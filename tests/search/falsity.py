"""Whether a statement of a certificate is false: a counterexample, found with 50 digits or exactly.

Nothing here is shared with ``verify.py``: programs are evaluated with dual numbers at sampled points. ``find`` returns a text
where the statement is certainly false, else "": where no counterexample is found it may be true or not. Points are looked at in
doubles first, by programs that are compiled to Python; what seems to be a counterexample there is looked at again with 50 digits.
"""

from __future__ import annotations

import functools
import itertools
import json
import math
import random
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import Any

import mpmath
from mpmath import mpf

DIGITS, TRIES, SLACK, HUGE, INF = 50, 40, 1e-9, 1e300, math.inf
Point = list[Any]
Rows = list[list[Any]]


class Missing(Exception):
    """A function has no value at a point."""


def as_mpf(x: Any) -> Any:
    """A number of JSON with 50 digits."""
    return mpf(x) if x in ("inf", "-inf") else mpf(Fraction(x).numerator) / Fraction(x).denominator


def as_float(x: Any) -> float:
    """A number of JSON as a double."""
    return float(x) if x in ("inf", "-inf") else float(Fraction(x))


READ = {  # Of each rule: the parts of a model on which the truth of its statements depends, besides the class.
    **dict.fromkeys(("A0", "A1", "A2", "A3", "A4", "A5", "A5'", "S-convex"), ("constraints",)), "S-f": ("f",),
    "S-start": ("constraints", "q0"), "O-theta": ("theta", "damping"), "O-g": ("g", "C"), "O-dry": ("theta", "H"),
    "O-steps": ("steps",), "F-jacobians": ("f", "g", "h"),
    **dict.fromkeys(("F-step", "F-W"), ("f", "g", "M", "steps", "theta", "gamma")),
    "F-mlcp": ("f", "g", "h", "M", "steps", "theta", "gamma"),
    "F-unique": ("f", "g", "h", "M", "steps", "theta", "gamma", "law"),
    "3.1": ("law",), "4.1": ("D",), "5.1": ("B", "C"), "5.2": ("A", "B", "C"),
    **dict.fromkeys(("5.4a", "5.4c"), ("C", "D", "e", "law")), "5.x0": ("C", "D", "e", "law", "x0"),
    "5.4b": ("D", "law"), "7.1": ("A", "f", "C", "D", "e", "law"),
    **dict.fromkeys(("M-T", "M-A2"), ("F", "S", "phi")), "M-C": ("C",), "M-A1": ("F",),
    **dict.fromkeys(("M-A3", "M-24"), ("F", "S", "phi", "C")),
}  # fmt: skip
NAMES = {  # The numbers that a statement may have.
    "A0": "c", "A1": "a b", "A2": "speed", "A3": "turn", "A4": "M M_contact", "A5": "gamma rho", "A5'": "gamma",
    "S-f": "K_f L_f L_t", "F-step": "h", "F-W": "h", "4.1": "least", "5.2": "omega", "M-A2": "a_1 a_2", "M-A3": "alpha beta",
    "M-24": "L",
}  # fmt: skip


# -- functions


class Dual:
    """A value with its gradient."""

    __slots__ = ("g", "v")

    def __init__(self, v: Any, g: list[Any]) -> None:
        self.v, self.g = v, g


def power(v: Any, n: Fraction) -> tuple[Any, Any]:
    """v^n and its derivative: of v < 0 for integers alone."""
    if (v < 0 and n.denominator > 1) or (v == 0 and n < 0):
        raise Missing
    if n.denominator == 1:
        return v ** int(n), (n.numerator * v ** int(n - 1) if n >= 1 or v else 0 * v)
    m = n.numerator / mpf(n.denominator) if isinstance(v, mpf) else float(n)
    return v**m, (m * v ** (m - 1) if v or n > 1 else v + INF)


SIMPLE: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    "exp": lambda x: (mpmath.exp(x), mpmath.exp(x)),
    "sin": lambda x: (mpmath.sin(x), mpmath.cos(x)),
    "cos": lambda x: (mpmath.cos(x), -mpmath.sin(x)),
    "tanh": lambda x: (mpmath.tanh(x), 1 - mpmath.tanh(x) ** 2),
}
LINES = {
    "exp": "math.exp({0})|v{1}", "sin": "math.sin({0})|math.cos({0})", "cos": "math.cos({0})|-math.sin({0})",
    "tanh": "math.tanh({0})|1-v{1}*v{1}",
}  # fmt: skip


def digits(program: Any, point: Point) -> list[Dual]:
    """All nodes of a program at a point, with 50 digits; nan from where a value is huge."""
    n, found = len(point), []
    for op, i, *rest in program["steps"]:
        if op == "in":
            node = Dual(point[i], [mpf(int(k == i)) for k in range(n)])
        elif op == "const":
            node = Dual(as_mpf(i), [mpf(0)] * n)
        elif op == "add":
            a, b = found[i], found[rest[0]]
            node = Dual(a.v + b.v, [x + y for x, y in zip(a.g, b.g, strict=True)])
        elif op == "mul":
            a, b = found[i], found[rest[0]]
            node = Dual(a.v * b.v, [a.v * y + b.v * x for x, y in zip(a.g, b.g, strict=True)])
        elif op == "fmax":
            node = found[i] if found[i].v >= found[rest[0]].v else found[rest[0]]
        else:
            f, d = power(found[i].v, Fraction(rest[0])) if op == "pow" else SIMPLE[op](found[i].v)
            node = Dual(f, [d * a if a else mpf(0) for a in found[i].g])
        if not abs(node.v) < HUGE:
            raise OverflowError
        found.append(node)
    return found


@functools.lru_cache(20000)
def compiled(text: str) -> tuple[Callable[[Point], list[Dual]], Callable[[Point], list[float]]]:
    """A program in doubles: its values with gradients, and the values of all its nodes."""
    program = json.loads(text)
    n, lines, plain, slopes = program["n"], [], [], []
    space: dict[str, Any] = {"math": math, "power": power, "Dual": Dual, "inf": INF}
    for k, (op, i, *rest) in enumerate(program["steps"]):
        u, own = f"v{i}", {} if op in ("in", "const") else slopes[i]
        if op == "in":
            line, grad = f"v{k} = p[{i}]", {i: "1.0"}
        elif op == "const":
            line, grad = f"v{k} = {as_float(i)!r}", {}
        elif op in ("add", "mul"):
            other, w = slopes[rest[0]], f"v{rest[0]}"
            line, grad = f"v{k} = {u} {'+' if op == 'add' else '*'} {w}", {}
            for j in sorted({*own, *other}):
                factors = ("", "") if op == "add" else (f"{w}*", f"{u}*")
                grad[j] = " + ".join(by + g[j] for by, g in zip(factors, (own, other), strict=True) if j in g)
        elif op == "fmax":
            line, other = f"c{k} = {u} >= v{rest[0]}; v{k} = {u} if c{k} else v{rest[0]}", slopes[rest[0]]
            grad = {j: f"{own.get(j, '0.0')} if c{k} else {other.get(j, '0.0')}" for j in sorted({*own, *other})}
        elif op == "pow":
            space[f"n{k}"] = Fraction(rest[0])
            line = f"v{k}, d{k} = power({u}, n{k})"
            grad = {j: f"d{k}*{a} if {a} else 0.0" for j, a in own.items()}
        else:
            f, d = LINES[op].format(u, k).split("|")
            line = f"v{k} = {f}"
            grad = {j: f"({d})*{a}" for j, a in own.items()}
        lines.append(line)
        plain.append(line)
        slopes.append({j: a if a == "1.0" else f"g{k}_{j}" for j, a in grad.items()})
        lines += [f"g{k}_{j} = {a}" for j, a in grad.items() if a != "1.0"]
    duals = ", ".join(f"Dual(v{k}, [{', '.join(slopes[k].get(j, '0.0') for j in range(n))}])" for k in program["outputs"])
    body = "\n    ".join([f"return [{', '.join(f'v{k}' for k in range(len(slopes)))}]"])
    text = "\n    ".join(["def values(p):", *lines, f"return [{duals}]"]) + "\n"
    text += "\n    ".join(["def nodes(p):", *plain, body])
    exec(text, space)
    return space["values"], space["nodes"]


class Function:
    """A program of a model, evaluated in doubles at points of doubles, else with 50 digits; nan where a value is huge."""

    def __init__(self, data: Any) -> None:
        self.data, self.inputs, self.kinks = data, data["inputs"], [s[1:] for s in data["steps"] if s[0] == "fmax"]

    @functools.cached_property
    def fast(self) -> tuple[Callable[[Point], list[Dual]], Callable[[Point], list[float]]]:
        """In doubles: the values, and those of all nodes."""
        return compiled(json.dumps({"n": len(self.inputs), "steps": self.data["steps"], "outputs": self.data["outputs"]}))

    def values(self, point: Point) -> list[Dual]:
        """The values at a point."""
        try:
            if point and isinstance(point[-1], mpf):
                nodes = digits(self.data, point)
                return [nodes[k] for k in self.data["outputs"]]
            found = self.fast[0](point)
            if all(-HUGE < f.v < HUGE for f in found):
                return found
        except OverflowError:
            pass
        return [Dual(math.nan, [math.nan] * len(point)) for _ in self.data["outputs"]]

    def nodes(self, point: Point) -> list[Any]:
        """The values of all nodes."""
        try:
            return [f.v for f in digits(self.data, point)] if point and isinstance(point[-1], mpf) else self.fast[1](point)
        except OverflowError:
            return [math.nan] * len(self.data["steps"])


def functions(item: Any) -> Any:
    """Data in which all programs are functions."""
    if isinstance(item, dict):
        return Function(item) if "steps" in item and "outputs" in item else {key: functions(part) for key, part in item.items()}
    return [functions(part) for part in item] if isinstance(item, list) else item


# -- vectors and matrices, lists of rows, of any kind of numbers


def norm(v: Any) -> Any:
    """The length of a vector."""
    return sum(x * x for x in v) ** 0.5


def dot(a: Any, b: Any) -> Any:
    """The scalar product."""
    return sum(x * y for x, y in zip(a, b, strict=True))


def minus(a: Any, b: Any) -> list[Any]:
    """The difference of two vectors."""
    return [x - y for x, y in zip(a, b, strict=True)]


def plus(A: Rows, B: Rows, factor: Any = 1) -> Rows:
    """A and a number times B."""
    return [[x + factor * y for x, y in zip(a, b, strict=True)] for a, b in zip(A, B, strict=True)]


def times(A: Rows, B: Rows) -> Rows:
    """The product."""
    return [[dot(row, column) for column in zip(*B, strict=True)] for row in A]


def least_eigenvalue(M: Rows) -> Any:
    """Of the symmetric part."""
    if not M:
        return 0.0
    S = [[(x + y) / 2 for x, y in zip(a, b, strict=True)] for a, b in zip(M, zip(*M, strict=True), strict=True)]
    if len(S) == 1:
        return S[0][0]
    if len(S) == 2:
        (a, b), (_, d) = S
        return (a + d) / 2 - (((a - d) / 2) ** 2 + b * b) ** 0.5
    return min(mpmath.eigsy(mpmath.matrix(S), eigvals_only=True))


def solved(M: Rows, B: Rows) -> tuple[Any, Rows]:
    """The determinant of M, and M^-1 B where it is not 0."""
    A, n, found = [[*a, *b] for a, b in zip(M, B, strict=True)], len(M), 1
    for k in range(n):
        pivot = max(range(k, n), key=lambda i: abs(A[i][k]))
        if not A[pivot][k]:
            return 0, []
        if pivot != k:
            A[k], A[pivot], found = A[pivot], A[k], -found
        found = found * A[k][k]
        for i in range(n):
            if i != k and A[i][k]:
                factor = A[i][k] / A[k][k]
                A[i] = [x - factor * y for x, y in zip(A[i], A[k], strict=True)]
    return found, [[x / A[k][k] for x in A[k][n:]] for k in range(n)]


def det(M: Rows) -> Any:
    """The determinant."""
    return M[0][0] * M[1][1] - M[0][1] * M[1][0] if len(M) == 2 else solved(M, [[] for _ in M])[0]


class Sampler:
    """Points in the scope of a statement: ends, the model's own numbers, numbers of all sizes.

    ``real`` reads numbers; ``tight`` is the rounding of a difference, relative; ``width`` a step that shows a derivative, and
    ``bare`` is 0, but for rounding.
    """

    def __init__(self, model: Any, statement: Any, seed: int, real: Callable[[Any], Any]) -> None:
        scope = statement["scope"] or {}
        self.real, self.rng = real, random.Random(seed)
        self.tight, self.width, self.bare = (1e-24, 1e-20, 1e-40) if real is as_mpf else (1e-14, 1e-6, 1e-13)
        ends = dict(scope.get("states") or {})
        if scope.get("time"):
            ends["t"] = scope["time"]
        self.box = {name: (real(low), real(high)) for name, (low, high) in ends.items()}
        self.own, self.inner = [real(x) for x in own_numbers(model)], {}

    def whole(self) -> Sampler:
        """The same without a box."""
        other = object.__new__(Sampler)
        other.__dict__.update(self.__dict__, box={})
        return other

    def ends(self, name: str) -> tuple[Any, Any]:
        """Of the interval of an input."""
        return self.box.get(name, (-INF, INF))

    def number(self, low: Any = -INF, high: Any = INF) -> Any:
        """A number between."""
        rng = self.rng
        if (low, high) not in self.inner:
            self.inner[low, high] = [x for x in self.own if low <= x <= high]
        inner, kind = self.inner[low, high], rng.random()
        if inner and kind < 0.4:
            x = rng.choice(inner)
            return min(max(x + rng.choice([0, 0, 1e-6, -1e-6]), low), high)
        if low > -INF and high < INF:
            return rng.choice([low, high]) if kind < 0.6 else low + (high - low) * rng.random()
        x = self.real(rng.choice([-1, 1]) * 10 ** rng.uniform(-3, 1.5 if kind < 0.9 else 5))
        return min(max(x, low), high) if kind < 0.9 or low <= x <= high else low if low > -INF else high if high < INF else x

    def point(self, names: Sequence[str]) -> Point:
        """A point for these inputs."""
        return [self.number(*self.ends(name)) for name in names]

    def near(self, point: Point, names: Sequence[str]) -> Point:
        """A point in the scope near another."""
        size = 10 ** self.rng.uniform(-6, 1)
        moved = [x + size * self.rng.gauss(0, 1) * self.rng.choice([0, 1, 1]) for x in point]
        return self.into(moved, names)

    def into(self, point: Point, names: Sequence[str]) -> Point:
        """The nearest point in the scope."""
        return [min(max(x, low), high) for x, (low, high) in zip(point, map(self.ends, names), strict=True)]

    def holds(self, point: Point, names: Sequence[str]) -> bool:
        """Whether a point is in the scope."""
        return all(low <= x <= high for x, (low, high) in zip(point, map(self.ends, names), strict=True))

    def pairs(self, names: Sequence[str], fixed: int = 0) -> Iterator[tuple[Point, Point]]:
        """Pairs of points in the scope; the first ``fixed`` inputs are the same."""
        for _ in range(TRIES):
            a = self.point(names)
            b = self.near(a, names) if self.rng.random() < 0.5 else self.point(names)
            yield a, a[:fixed] + b[fixed:]


@functools.lru_cache(5000)
def numbers_in(text: str) -> tuple[str, ...]:
    """The numbers in data, each once, below 1000."""

    def found(item: Any) -> Iterator[str]:
        if isinstance(item, dict | list):
            for part in item.values() if isinstance(item, dict) else item:
                yield from found(part)
        elif isinstance(item, str):
            try:
                if abs(Fraction(item)) < 1000:
                    yield item
            except (ValueError, ZeroDivisionError):
                return

    return tuple(dict.fromkeys(found(json.loads(text))))


def own_numbers(model: Any) -> list[str]:
    """Numbers to look at: those of a model and their opposites, and a few."""
    own = numbers_in(json.dumps(model))
    return [*("0", "1", "-1", "1/2", "2", "-2"), *own, *(x[1:] if x[:1] == "-" else f"-{x}" for x in own)]


def kink(f: Function, a: Point, b: Point, sampler: Sampler) -> bool:
    """Whether a gradient jumps between two points: where the arguments of a max are equal."""
    for i, j in f.kinks:

        def gap(at: Any, i: int = i, j: int = j) -> Any:
            nodes = f.nodes([x + at * (y - x) for x, y in zip(a, b, strict=True)])
            return nodes[i] - nodes[j]

        low, high = sampler.real(0), sampler.real(1)
        if not gap(low) * gap(high) < 0:
            continue
        for _ in range(50 if sampler.real is as_float else 120):
            middle = (low + high) / 2
            low, high = (middle, high) if gap(middle) * gap(low) > 0 else (low, middle)
        width = sampler.width * sampler.width if sampler.real is as_float else sampler.width
        sides = [f.values([x + at * (y - x) for x, y in zip(a, b, strict=True)]) for at in (low - width, high + width)]
        if any(norm(minus(u.g, v.g)) > 1e-6 * (1 + norm(u.g)) for u, v in zip(*sides, strict=True)):
            return True
    return False


def not_convex(f: Function, sampler: Sampler, sign: int = 1, fixed: int = 0) -> str:
    """A chord below the function, or a point without value."""
    for a, b in sampler.pairs(f.inputs, fixed):
        middle, d = [(x + y) / 2 for x, y in zip(a, b, strict=True)], minus(b, a)
        for low, high, at in zip(f.values(a), f.values(b), f.values(middle), strict=True):
            falls = sign * dot(minus(high.g, low.g), d) < -1e-13 * (norm(low.g) + norm(high.g)) * norm(d)
            if sign * (at.v - (low.v + high.v) / 2) > sampler.tight * (1 + abs(low.v) + abs(high.v)):
                return f"a chord from {a} to {b}"
            if falls and sampler.real is as_float:
                return "perhaps a chord that is too short for doubles"
    return ""


@functools.lru_cache(20000)
def no_room(rows: tuple[tuple[float, ...], ...], strict: bool) -> bool:
    """Whether {x : b + a'x >= 0} of rows (b, a) is empty, or, if strict, has no interior, by linear programming."""
    from scipy.optimize import linprog

    n = len(rows[0]) - 1
    A = [[*(-x for x in a), max(1.0, math.hypot(*a)) if strict else 0.0] for _, *a in rows]
    found = linprog([0.0] * n + [-1.0], A, [b for b, *_ in rows], bounds=[(None, None)] * n + [(None, 1.0)])
    return found.status == 2 or (strict and found.status == 0 and -found.fun < 1e-12)


def no_interior(f: Function, sampler: Sampler) -> str:
    """No point where concave rows are > 0: their tangents, at points that get better, leave no room."""
    n = len(f.inputs)
    near = [[float(x) for x in sampler.point(f.inputs)] for _ in range(4)]
    try:
        cuts: list[tuple[float, ...]] = []
        for a in [[0.0] * n, *near, *near, *near]:
            rows = f.values(a)
            if not rows or min(row.v for row in rows) > 0:
                return ""
            cuts += [(row.v - dot(row.g, a), *row.g) for row in rows if all(abs(x) < HUGE for x in (row.v, *row.g))]
            low = min(rows, key=lambda row: row.v)
            near = [[x - low.v / (norm(low.g) ** 2) * d for x, d in zip(a, low.g, strict=True)] if any(low.g) else a] * 4
    except Missing:
        return ""
    return "no interior point" if cuts and no_room(tuple(cuts), True) else ""


def no_statement(model: Any, statement: Any) -> str:
    """Why it says nothing: numbers or a scope that have no meaning, parts of the model that do not fit together."""
    id, own = statement["id"], {name: model.get(name) for name in READ[statement["id"]]}
    names = ["lower bound of g"] if id == "O-g" else ["radius of A(0)"] if id == "O-dry" else NAMES.get(id, "").split()
    if not set(statement["value"]) <= set(names) or not set(statement["scope"] or ()) <= {"states", "time"}:
        return "a number or a scope without meaning"
    if "law" in own:
        size = len(model["D"]) if "D" in model else len(model["f"]["inputs"]) - 1 - len(model["x0"])
        if any(block["kind"] != "box" for block in own["law"]) or sum(len(block["lower"]) for block in own["law"]) != size:
            return "a law of another size or kind"
    kinds = {"A": "SweepingProcess", "S": "SweepingProcess", "O": "FrictionOscillator", "F": "FirstOrderSystem"}
    if model["class"] != (kinds | {"M": "MonotoneInclusion"}).get(id[0], "LureSystem"):
        return "a hypothesis of another class of models"
    if model["class"] == "FirstOrderSystem" and any(Fraction(step) <= 0 for step in model["steps"]):
        return "a step that is not > 0"
    first = {
        "SweepingProcess": "f",
        "FrictionOscillator": "g",
        "FirstOrderSystem": "f",
        "LureSystem": "A",
        "MonotoneInclusion": "F",
    }
    inputs = model[first[model["class"]]]["inputs"]
    timed = model["class"] in ("SweepingProcess", "FirstOrderSystem")
    if timed and inputs[:1] != ["t"]:
        return "a model without time"
    if any(
        row["graph"]["inputs"][:1] != ["t"] or not set(row["graph"]["inputs"]) <= set(inputs)
        for row in own.get("constraints") or ()
    ):
        return "a constraint of other inputs"
    if any(len(theta["inputs"]) != 1 for theta in own.get("theta") or () if model["class"] == "FrictionOscillator"):
        return "friction of other inputs"
    return ""


def at(model: Any, values: dict[str, Fraction]) -> Any:
    """The model with numbers in place of its parameters."""
    names = list(values)

    def put(item: Any) -> Any:
        if isinstance(item, list):
            return [put(part) for part in item]
        if not (isinstance(item, dict) and "inputs" in item):
            return {name: put(part) for name, part in item.items()} if isinstance(item, dict) else item
        own = [name for name in item["inputs"] if name not in names]
        fixed = {item["inputs"].index(name): str(values[name]) for name in names}
        places = {k: own.index(name) for k, name in enumerate(item["inputs"]) if name in own}
        steps = [
            step if step[0] != "in" else ["const", fixed[step[1]]] if step[1] in fixed else ["in", places[step[1]]]
            for step in item["steps"]
        ]
        if own or len(item["outputs"]) != 1:
            return {"inputs": own, "steps": steps, "outputs": item["outputs"]}
        return str(Fraction(str(digits({"steps": steps}, [])[item["outputs"][0]].v)))

    return {name: put(part) for name, part in model.items() if name != "parameters"}


def member_by_member(model: Any) -> Any:
    """The model with each constraint of its families; a graph that reads a number has it as a constant."""
    rows = []
    for row in model.get("constraints") or ():
        for one in row.get("members", [None]):
            if one is None:
                rows.append(row)
                continue
            graph, first = row["graph"], 1 + len(one["states"])
            numbers = dict(enumerate(one["numbers"], start=first))
            steps = [["const", numbers[s[1]]] if s[0] == "in" and s[1] in numbers else s for s in graph["steps"]]
            own = {"inputs": ["t", *one["states"]], "steps": steps, "outputs": graph["outputs"]}
            rows.append({"graph": own} | ({"delta": row["delta"]} if "delta" in row else {}))
    return {**model, "constraints": rows}


def over_parameters(model: Any, statement: Any, seed: int) -> str:
    """A counterexample at some values of the parameters."""
    scope, rng = statement["scope"] or {}, random.Random(seed)
    ranges = {name: [Fraction(end) for end in ends] for name, ends in (scope.get("parameters") or {}).items()}
    if list(ranges) != model.get("parameters", []) or any(low > high for low, high in ranges.values()):
        return "other parameters, or an empty interval"
    if any(set(row.get("numbers", ())) & set(ranges) for row in model.get("constraints") or ()):
        return "a number of a family has the name of a parameter"
    bare = {**statement, "scope": {name: part for name, part in scope.items() if name != "parameters"} or None}
    for share in (0, 1, None, None):
        values = {
            name: low + (high - low) * (Fraction(rng.randint(0, 8), 8) if share is None else share)
            for name, (low, high) in ranges.items()
        }
        with mpmath.workdps(DIGITS):
            try:
                here, there = at(model, values), at(bare, values)
            except Missing:
                return "a number has no value"
        if found := find(here, there, seed):
            return f"{found}, for {values}"
    return ""


def find(model: Any, statement: Any, seed: int = 0) -> str:
    """A counterexample in words; "" where none is found."""
    if model.get("parameters") or (statement["scope"] or {}).get("parameters"):
        return over_parameters(model, statement, seed)
    if any(row.get("members") == [] for row in model.get("constraints") or ()):
        return "a family without members"
    model = member_by_member(model)
    if found := no_statement(model, statement):
        return found
    finder, read = FINDERS[statement["id"]], functions(model)

    def look(real: Callable[[Any], Any]) -> str:
        try:
            return finder(read, statement, Sampler(model, statement, seed, real))
        except Missing:
            return "a function has no value at a point of the scope"

    if finder not in EXACT:
        try:
            if not look(as_float):
                return ""
        except ArithmeticError:  # A number that is no double.
            pass
    with mpmath.workdps(DIGITS):
        return look(as_mpf)


# -- sweeping processes


def gaps_of(model: Any, sampler: Sampler) -> list[tuple[Function, Any]]:
    """The constraints with their delta or None."""
    return [(row["graph"], sampler.real(row["delta"]) if "delta" in row else None) for row in model["constraints"]]


def outside(look: Callable[..., str]) -> Callable[..., str]:
    """A search for a counterexample that may leave the scope: where a function has no value there, none is found."""

    @functools.wraps(look)
    def careful(*given: Any) -> str:
        try:
            return look(*given)
        except Missing:
            return ""

    return careful


def s_convex(model: Any, statement: Any, sampler: Sampler) -> str:
    for g, _ in gaps_of(model, sampler):
        if found := not_convex(g, sampler, fixed=1):
            return found
    return ""


def regular(model: Any, statement: Any, sampler: Sampler) -> str:
    id, value = statement["id"], {name: sampler.real(x) for name, x in statement["value"].items()}
    if any(x < 0 for x in value.values()) or value.get("a") == 0 or value.get("c") == 0:
        return "a number has the wrong sign"
    for g, delta in gaps_of(model, sampler):
        if delta is not None and delta <= 0:
            return "delta <= 0"
        for k, (a, b) in enumerate(sampler.pairs(g.inputs)):
            try:
                found = _irregular(id, value, g, delta, a, b, sampler) or (
                    id != "A0" and k < 6 and _turning(g, delta, a, sampler)
                )
            except Missing:
                if delta is None or id == "A0":
                    raise
                continue  # It may be no point of U.
            if found:
                return found
    return ""


@outside
def _too_near(c: Any, g: Function, delta: Any, a: Point, sampler: Sampler) -> str:
    """A point out of U that is nearer than c to one of the boundary of {g >= 0}, as steeply down as it goes."""
    for _ in range(20):
        (at,) = g.values(a)
        size = norm(at.g[1:])
        if not size or abs(at.v) < sampler.bare:
            break
        a = [a[0], *(x - at.v / size**2 * d for x, d in zip(a[1:], at.g[1:], strict=True))]
    if not size or not sampler.holds(a, g.inputs):
        return ""
    down = [a[0], *(x - (1 - SLACK) * c * d / size for x, d in zip(a[1:], at.g[1:], strict=True))]
    near = abs(at.v) <= sampler.bare and sampler.holds(down, g.inputs) and g.values(down)[0].v <= -delta - SLACK
    return f"{down} is near" if near else ""


@outside
def _turning(g: Function, delta: Any, a: Point, sampler: Sampler) -> str:
    """A point of U, down from a, at which the gradient jumps: as in the centre of a distance."""
    (at,) = g.values(a)
    down, scale = [0, *(-d for d in at.g[1:])], norm(at.g[1:])
    if not 1e-3 < scale < 1e6:  # Else the widths below are no small ones.
        return ""

    def slope(length: Any) -> Any:
        return g.values([x + length * d for x, d in zip(a, down, strict=True)])[0]

    low, high = sampler.real("0"), (abs(at.v) + 10) / scale**2
    if not dot(slope(high).g, down) > 0:
        return ""
    for _ in range(50 if sampler.real is as_float else 170):
        middle = (low + high) / 2
        low, high = (low, middle) if dot(slope(middle).g, down) > 0 else (middle, high)
    width = sampler.width * sampler.width if sampler.real is as_float else sampler.width

    def apart(width: Any) -> Any:
        return norm(minus(slope(low - width / scale).g[1:], slope(high + width / scale).g[1:]))

    behind, wide, narrow = slope(high + width / scale), apart(width), apart(width / 16)
    jump = wide > 1e-3 * scale and narrow > wide / 2  # Of a gradient that is steep alone a sixteenth is left.
    inside = (delta is None or behind.v > -delta) and sampler.holds(
        [x + high * d for x, d in zip(a, down, strict=True)], g.inputs
    )
    return f"a gradient that jumps below {a}" if jump and inside else ""


def _irregular(id: str, value: Any, g: Function, delta: Any, a: Point, b: Point, sampler: Sampler) -> str:
    (at,) = g.values(a)
    size = norm(at.g[1:])
    if id == "A0":
        if delta is None:
            return ""
        if "c" not in value:
            return "a point out of U" if at.v <= -delta else ""
        return _too_near(value["c"], g, delta, a, sampler)
    if delta is not None and at.v <= -delta:
        return ""
    if id == "A1":
        return f"|grad g| = {size} at {a}" if size < value["a"] * (1 - SLACK) or size > value["b"] * (1 + SLACK) else ""
    if id == "A2":
        return f"at {a}" if abs(at.g[0]) > value["speed"] * (1 + SLACK) + 1e-30 else ""
    return _bent(id, value, g, delta, a, b, sampler)


@outside
def _bent(id: str, value: Any, g: Function, delta: Any, a: Point, b: Point, sampler: Sampler) -> str:
    """Where the gradient turns, or is bent, too fast; it is looked at beyond the ends of the scope by a hair."""
    (at,) = g.values(a)
    shift = [0, *minus(b, a)[1:]] if id == "A4" else [1] + [0] * (len(a) - 1)
    length = norm(shift)
    if length == 0 or (sampler.box and any(name in sampler.box for name in g.inputs) and a == b):
        return ""
    (other,) = g.values([x + sampler.width * d / length for x, d in zip(a, shift, strict=True)])
    rate, slack = norm(minus(other.g[1:], at.g[1:])) / sampler.width, 1e-6 if sampler.real is as_mpf else 1e-4
    if id == "A3":
        return f"turns at {rate} at {a}" if rate > value["turn"] * (1 + slack) + slack else ""
    if rate > (value["M_contact"] if at.v > 0 else value["M"]) * (1 + slack) + slack:
        return f"curved by {rate} at {a}"
    return "a kink in U" if delta is None and kink(g, a, b, sampler) else ""


def qualified(model: Any, statement: Any, sampler: Sampler) -> str:
    gamma, gaps, names = sampler.real(statement["value"]["gamma"]), [g for g, _ in gaps_of(model, sampler)], model["f"].inputs
    rho = sampler.real(statement["value"].get("rho", "inf"))
    if gamma < 1 or (statement["id"] == "A5" and len(gaps) > 1 and rho <= 0):
        return "gamma < 1, or rho <= 0"
    for a, _ in sampler.pairs(names):
        try:
            if found := opposed(gaps, names, a, gamma, rho if statement["id"] == "A5" else 0, sampler):
                return found
        except Missing:
            continue  # It is no point of Q(t).
    return ""


def opposed(gaps: list[Function], names: list[str], a: Point, gamma: Any, rho: Any, sampler: Sampler) -> str:
    """Normals of two near constraints that oppose each other, on a way from a point towards points where two are near."""
    for _ in range(6):
        found = [g.values([a[names.index(name)] for name in g.inputs])[0] for g in gaps]
        own = [dict(zip(g.inputs, f.g, strict=True)) for g, f in zip(gaps, found, strict=True)]
        slopes = [[one.get(v, 0) for v in names[1:]] for one in own]
        near = [k for k, f in enumerate(found) if f.v <= max(rho, sampler.bare) and norm(slopes[k])]
        if all(f.v >= -sampler.bare for f in found):
            for i, j in itertools.combinations(near, 2):
                p, q = ([x / norm(slopes[k]) for x in slopes[k]] for k in (i, j))
                if norm([x + y for x, y in zip(p, q, strict=True)]) * gamma < 2 * (1 - SLACK):
                    return f"the normals of {i} and {j} at {a}"
        k = sampler.rng.randrange(len(gaps))
        if size := norm(slopes[k]):
            step = (min(max(found[k].v, 0), rho / 2) - found[k].v) / size**2
            a = sampler.into([a[0], *(x + step * d for x, d in zip(a[1:], slopes[k], strict=True))], names)
    return ""


def velocity(model: Any, statement: Any, sampler: Sampler) -> str:
    K, L = (sampler.real(statement["value"][name]) for name in ("K_f", "L_f"))
    rate, f = sampler.real(statement["value"].get("L_t", "inf")), model["f"]
    for a, b in sampler.pairs(f.inputs, 1):
        here, there = f.values(a), f.values(b)
        if norm([x.v - y.v for x, y in zip(here, there, strict=True)]) > K * norm(minus(a, b)) * (1 + SLACK) + sampler.tight:
            return f"K_f, from {a} to {b}"
        if norm(x.v for x in here) > L * (1 + norm(a[1:])) * (1 + SLACK):
            return f"L_f at {a}"
        if norm(x.g[0] for x in here) > rate * (1 + SLACK) + 1e-30:
            return f"L_t at {a}"
    return ""


def start(model: Any, statement: Any, sampler: Sampler) -> str:
    point = dict(zip(model["f"].inputs, map(sampler.real, ["0", *model["q0"]]), strict=True))
    low = [g.values([point[name] for name in g.inputs])[0].v for g, _ in gaps_of(model, sampler)]
    rounding = sampler.bare * max(map(abs, point.values()))  # Of q_0 = p, put in as 50 digits in one place and as p in another.
    return "g < 0" if any(x < -rounding for x in low) else ""


# -- oscillators


def friction(model: Any, statement: Any, sampler: Sampler) -> str:
    for theta in model["theta"]:
        half = sampler.whole()
        half.box = {theta.inputs[0]: (sampler.real(0), INF)}
        if theta.values([sampler.real("1e-30")])[0].g[0] < -1e-25:
            return "theta'(0) < 0"
        if found := not_convex(theta, half):
            return found
        for a, b in half.pairs(theta.inputs):
            if kink(theta, a, b, sampler):
                return "a kink"
            if a[0] > 0 and theta.values(a)[0].g[0] < -sampler.bare:
                return "it falls"
    if model["damping"] and least_eigenvalue([[*map(sampler.real, row)] for row in model["damping"]]) < -1e-12:
        return "the damping is not psd"
    return ""


def potential(model: Any, statement: Any, sampler: Sampler) -> str:
    bound, whole, g = sampler.real(statement["value"]["lower bound of g"]), sampler.whole(), model["g"]
    if found := not_convex(g, sampler) or not_convex(model["C"], whole, -1) or no_interior(model["C"], sampler.whole()):
        return found
    for a, _ in whole.pairs(g.inputs):
        for _ in range(8):  # Down the slope.
            (at,) = g.values(a)
            if at.v < bound - SLACK * (1 + abs(bound)):
                return f"g = {at.v} at {a}"
            step = 10 ** sampler.rng.uniform(-3, 0)
            a = [x - step * d for x, d in zip(a, at.g, strict=True)]
    return ""


def dry(model: Any, statement: Any, sampler: Sampler) -> str:
    r, n = sampler.real(statement["value"]["radius of A(0)"]), len(model["g"].inputs)
    if r <= 0:
        return "r <= 0"
    slopes = [theta.values([sampler.real("1e-30")])[0].g[0] for theta in model["theta"]]
    H = [[[sampler.real(x) for x in row] for row in rows] for rows in model["H"]]
    for k in range(4 * TRIES):
        d = [sampler.rng.gauss(0, 1) for _ in range(n)] if k >= n else [int(i == k) for i in range(n)]
        sigma = sum(f * norm(dot(row, d) for row in rows) for f, rows in zip(slopes, H, strict=True))
        if sigma < r * norm(d) * (1 - SLACK):
            return f"sigma in the direction {d}"
    return ""


def steps_grow(model: Any, statement: Any, sampler: Sampler) -> str:
    steps = [Fraction(x) for x in model["steps"]]
    return "" if steps and all(0 < a <= b for a, b in zip(steps, steps[1:] or steps, strict=False)) else "a step shrinks"


# -- first-order systems


def jacobians(model: Any, point: Point, whole: bool = True) -> dict[str, Rows]:
    """A, F, K, B, and C, D at a point; without the whole no C and D."""
    n, inputs = len(model["x0"]), len(model["f"].inputs)
    f, g = ([row.g for row in model[name].values(point)] for name in "fg")
    h = [row.g for row in model["h"].values(point)] if whole else []
    states, multipliers = slice(1, n + 1), slice(n + 1, inputs)
    parts = {
        "A": (f, states),
        "F": (f, multipliers),
        "K": (g, states),
        "B": (g, multipliers),
        "C": (h, states),
        "D": (h, multipliers),
    }
    return {name: [row[columns] for row in rows] for name, (rows, columns) in parts.items()}


def real_matrix(rows: Any, sampler: Sampler) -> Rows:
    """A matrix of JSON."""
    return [[sampler.real(x) for x in row] for row in rows]


def smooth(model: Any, statement: Any, sampler: Sampler) -> str:
    for a, b in sampler.pairs(model["f"].inputs):
        for name in "fgh":
            if any(abs(x) == INF for row in model[name].values(a) for x in row.g) or kink(model[name], a, b, sampler):
                return f"the derivative of {name} at {a}"
    return ""


def step_bound(model: Any, statement: Any, sampler: Sampler) -> str:
    h, M = sampler.real(statement["value"]["h"]), real_matrix(model["M"], sampler)
    steps, theta, gamma = [*map(sampler.real, model["steps"])], sampler.real(model["theta"]), sampler.real(model["gamma"])
    if h <= 0 or max(steps) > h or min(steps) <= 0 or det(M) == 0:
        return "h is below a step, or M is singular"
    sign = 1 if det(M) > 0 else -1
    for a, _ in sampler.pairs(model["f"].inputs):
        J = jacobians(model, a, whole=False)
        X = [[theta * x + gamma * y for x, y in zip(*rows, strict=True)] for rows in zip(J["A"], J["K"], strict=True)]
        if any(sign * det(plus(M, X, -h * k / 10)) <= 0 for k in range(11)):
            return f"singular at {a}"
    return ""


def mlcp(model: Any, statement: Any, sampler: Sampler) -> str:
    first, n = None, len(model["x0"])
    for a, _ in sampler.pairs(model["f"].inputs):
        J = jacobians(model, a)
        first = first or J
        if any(
            abs(x - y) > SLACK
            for name, M in J.items()
            for r, s in zip(M, first[name], strict=True)
            for x, y in zip(r, s, strict=True)
        ):
            return "the Jacobians vary"
    J = first or {}
    if any(x for row in J["F"] for x in row):
        return "f looks at a multiplier"
    M, theta, gamma = real_matrix(model["M"], sampler), sampler.real(model["theta"]), sampler.real(model["gamma"])
    for step in map(sampler.real, model["steps"]):
        W = plus(plus(M, J["A"], -step * theta), J["K"], -step * gamma)
        size, inner = solved(W, J["B"])
        if step <= 0 or abs(size) <= sampler.bare:
            return "W is singular"
        if not J["D"]:
            continue
        full = plus(J["D"], times(J["C"], inner), step * gamma) if n else J["D"]
        if statement["id"] == "F-mlcp" and least_eigenvalue(full) < -SLACK:
            return "W_mlcp is not psd"
        if statement["id"] == "F-unique" and (found := not_unique(model, full, inner, J["C"], sampler)):
            return found
    return ""


def is_empty(law: Any) -> bool:
    """Whether an interval of a law is empty."""
    return any(as_float(a) > as_float(b) for block in law for a, b in zip(block["lower"], block["upper"], strict=True))


def within(low: Any, high: Any) -> Any:
    """A number inside an interval."""
    if high < INF:
        return (low + high) / 2 if low > -INF else high - 1
    return low + 1 if low > -INF else 0


def kernel(W: Rows, sampler: Sampler) -> list[Any]:
    """A vector d, not 0, with W d = 0, of matrices of one or two rows; [] where none is known."""
    for d in ([1], [1, 0], [0, 1], *([[W[0][1], -W[0][0]], [W[1][1], -W[1][0]]] if len(W) == 2 else [])):
        if len(d) == len(W) and any(d) and all(abs(dot(row, d)) <= sampler.bare for row in W):
            return d
    return []


def not_unique(model: Any, W: Rows, B: Rows, C: Rows, sampler: Sampler) -> str:
    """No solution, or two with different B l, of -y in N_K(l), y = W l + C z + h_0, K a box, by all index sets; M is regular."""
    if is_empty(model["law"]):
        return "K is empty"
    m, n = len(W), len(model["x0"])
    if m > 3 or not det(real_matrix(model["M"], sampler)):
        return ""
    ends = [tuple(map(sampler.real, pair)) for b in model["law"] for pair in zip(b["lower"], b["upper"], strict=True)]
    t = sampler.number(*sampler.ends("t"))
    start = [row.v for row in model["h"].values([t] + [sampler.real(0)] * (n + m))]
    d = kernel(W, sampler)
    if d and all(low < high for low, high in ends) and any(dot(row, d) for row in B):
        l = [within(low, high) for low, high in ends]
        need = [-dot(row, l) - x for row, x in zip(W, start, strict=True)]
        full = n >= m and m == 1 and any(C[0])
        if full or all(abs(x) <= sampler.bare for x in need):
            return f"many l that are not told apart, along {d}"
    for _ in range(12):
        z = [sampler.rng.gauss(0, 1) * 10 ** sampler.rng.uniform(-1, 2) for _ in range(n)]
        q = [dot(row, z) + x for row, x in zip(C, start, strict=True)]
        if not all(abs(x) < HUGE for x in q):
            return ""
        solutions: list[Any] = []
        for codes in itertools.product((-1, 0, 1), repeat=m):
            l = [low if code < 0 else high if code > 0 else 0 for code, (low, high) in zip(codes, ends, strict=True)]
            if any(abs(x) == INF for x in l):
                continue
            free = [i for i in range(m) if not codes[i]]
            if free:
                part, right = [[W[i][j] for j in free] for i in free], [[-(dot(W[i], l) + q[i])] for i in free]
                size, inner = solved(part, right)
                if not abs(size) > sampler.bare:
                    if any(not any(row) and abs(r) > SLACK for row, (r,) in zip(part, right, strict=True)):
                        continue  # 0 l = r has no solution.
                    return ""
                for i, (x,) in zip(free, inner, strict=True):
                    l[i] = x
            y = [dot(row, l) + x for row, x in zip(W, q, strict=True)]
            inside = all(low - SLACK <= x <= high + SLACK for x, (low, high) in zip(l, ends, strict=True))
            signs = all(code == 0 or -code * x >= -SLACK for code, x in zip(codes, y, strict=True))
            if inside and signs:
                solutions.append([dot(row, l) for row in B])
        if not solutions:
            return "no solution"
        if any(norm(minus(a, b)) > 1e-4 for a, b in itertools.combinations(solutions, 2)):
            return "two solutions"
    return ""


# -- Lur'e systems


def law_ends(model: Any, sampler: Sampler) -> list[tuple[Any, Any]]:
    """The ends of the law's intervals."""
    return [tuple(map(sampler.real, pair)) for b in model["law"] for pair in zip(b["lower"], b["upper"], strict=True)]


def thin_law(model: Any, statement: Any, sampler: Sampler) -> str:
    return "no interior" if any(low >= high for low, high in law_ends(model, sampler)) else ""


def feedthrough(model: Any, statement: Any, sampler: Sampler) -> str:
    least = sampler.real(statement["value"]["least"])
    return "D" if least < 0 or least_eigenvalue(real_matrix(model["D"], sampler)) < least - SLACK * (1 + least) else ""


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
    CB = [[dot(line, [row[k] for row in B]) for k in range(m)] for line in C]
    if any(CB[i][j] != CB[j][i] for i in range(m) for j in range(m)):
        return "C B is not symmetric"
    if m and least_eigenvalue([[as_mpf(x) for x in row] for row in CB]) < -SLACK:
        return "C B is not psd"
    both = [*B, *([C[k][i] for k in range(m)] for i in range(len(B)))]
    return "" if not m or rank(CB) == rank(B) == rank(both) else "no P"


def grows(model: Any, statement: Any, sampler: Sampler) -> str:
    """The matrix P of the proof must serve; an eigenvalue of A beyond omega lets none serve."""
    if found := no_storage(model, statement, sampler):
        return found
    omega, P, A = sampler.real(statement["value"]["omega"]), real_matrix(statement["proof"]["P"], sampler), model["A"]
    if least_eigenvalue(P) <= 0:
        return "P is not definite"
    for a, b in sampler.pairs(A.inputs):
        here, there = A.values(a), A.values(b)
        J, d, v = [row.g for row in here], minus(a, b), [x.v - y.v for x, y in zip(here, there, strict=True)]
        Pd = [dot(row, d) for row in P]
        if dot(Pd, v) > omega * dot(Pd, d) + SLACK * (1 + norm(d)) * 1e-10:
            return f"from {a} to {b}"
        if all(abs(x) < INF for row in J for x in row):
            PJ = times(P, J)
            size = 1 + norm(x for row in PJ for x in row) + abs(omega) * norm(x for row in P for x in row)
            if least_eigenvalue(plus([[omega * x for x in row] for row in P], PJ, -1)) < -SLACK * size and not A.kinks:
                return f"the derivative at {a}"
    return ""


def one_range(model: Any, statement: Any, sampler: Sampler, x: Any = None) -> str:
    """5.4 and 5.x0 of one row, by cases."""
    id = statement["id"]
    if is_empty(model["law"]) and id != "5.4b":
        return "K is empty"
    if len(model["D"]) == 2 and id != "5.4b" and (found := two_ranges(model, id, sampler, x)):
        return found
    if len(model["D"]) != 1:
        return ""
    ((low, high),), D, C = law_ends(model, sampler), sampler.real(model["D"][0][0]), [sampler.real(c) for c in model["C"][0]]
    if low > high:
        return "K is empty"
    if (low > -INF and high < INF) or D > 0 or id == "5.4b" or isinstance(model.get("e"), dict | Function):
        return ""
    if D < 0 or not (low > -INF or high < INF):
        return "int dom Y* is empty"
    sign = 1 if low > -INF else -1
    e = sampler.real(model["e"][0]) if "e" in model else 0
    x = x if x is not None else [sampler.real(v) for v in model["x0"]] if id == "5.x0" else None
    if x is None:
        return "" if id == "5.4c" or any(C) or sign * e > 0 else "C = 0"
    return "" if sign * (dot(C, x) + e) > 0 else "C x + e has the other sign"


def two_ranges(model: Any, id: str, sampler: Sampler, x: Any) -> str:
    """Of two rows with D = [0, d; -d, 0], S is a product: D_ji (low_j, high_j) plus a half-line or everything."""
    D, ends = real_matrix(model["D"], sampler), law_ends(model, sampler)
    if D[0][0] or D[1][1] or D[0][1] != -D[1][0] or isinstance(model.get("e"), dict | Function):
        return ""
    if any(low == -INF and high == INF for low, high in ends):
        return "int dom Y* is empty"
    x = [sampler.real(v) for v in model["x0"]] if id == "5.x0" else x
    if x is None:
        return ""
    e = [sampler.real(v) for v in model.get("e", ["0", "0"])]
    for i, (low, high) in enumerate(ends):
        c, other = dot([sampler.real(v) for v in model["C"][i]], x) + e[i], D[1 - i][i]
        least, most = sorted(end * other for end in ends[1 - i]) if other else (0, 0)
        least, most = (-INF if high < INF else least), (INF if low > -INF else most)
        if not least < c < most:
            return f"C x + e is not in S, in row {i}"
    return ""


def not_at_rest(model: Any, statement: Any, sampler: Sampler) -> str:
    if any(x.v != 0 for x in model["A"].values([sampler.real("0")] * len(model["A"].inputs))):
        return "A(0)"
    if any(abs(x.v) > 0 for a, _ in sampler.pairs(["t"]) for x in model["f"].values(a)):
        return "f"
    if any(Fraction(x) for x in model.get("e", [])):
        return "e"
    if not all(low <= 0 <= high for low, high in law_ends(model, sampler)):
        return "0 is not in K"
    return one_range(model, statement, sampler, [0] * len(model["x0"]))


# -- monotone inclusions


def operator(model: Any, x: Point) -> list[Any]:
    """S and the gradient of phi."""
    total = [0 * y for y in x]
    if model["phi"] is not None:
        total = [a + b for a, b in zip(total, model["phi"].values(x)[0].g, strict=True)]
    if model["S"] is not None:
        total = [a + b.v for a, b in zip(total, model["S"].values(x), strict=True)]
    return total


def inside(model: Any, x: Point) -> Any:
    """The least row of C at x; infinite without rows, -1 where C has no value."""
    try:
        return min((row.v for row in model["C"].values(x)), default=INF)
    except Missing:
        return -1


def drift(model: Any, x: Point) -> list[Any]:
    """F - S."""
    return minus([row.v for row in model["F"].values(x)], operator(model, x))


def monotone(model: Any, statement: Any, sampler: Sampler) -> str:
    if model["phi"] is not None and (found := not_convex(model["phi"], sampler)):
        return found
    for a, b in sampler.pairs(model["F"].inputs):
        d, v = minus(a, b), minus(operator(model, a), operator(model, b))
        if dot(v, d) < -sampler.tight * (1 + norm(d) ** 2 + norm(v) * norm(d)):
            return f"from {a} to {b}"
    return ""


def bad_set(model: Any, statement: Any, sampler: Sampler) -> str:
    return not_convex(model["C"], sampler, -1) or no_interior(model["C"], sampler.whole())


def without_value(model: Any, statement: Any, sampler: Sampler) -> str:
    for a, _ in sampler.pairs(model["F"].inputs):
        model["F"].values(a)
    return ""


def linear_growth(model: Any, statement: Any, sampler: Sampler) -> str:
    a_1, a_2 = (sampler.real(statement["value"][name]) for name in ("a_1", "a_2"))
    for a, _ in sampler.pairs(model["F"].inputs):
        if norm(drift(model, a)) > (a_1 + a_2 * norm(a)) * (1 + SLACK) + 1e-30:
            return f"at {a}"
    return "a_1 < 0, or a_2" if a_1 < 0 or a_2 < 0 else ""


def one_sided(model: Any, statement: Any, sampler: Sampler) -> str:
    L = sampler.real(statement["value"]["L"])
    for a, b in sampler.pairs(model["F"].inputs):
        if inside(model, a) >= 0 and inside(model, b) >= 0:
            d, v = minus(a, b), minus(drift(model, a), drift(model, b))
            if dot(v, d) > (L + SLACK * (1 + abs(L))) * norm(d) ** 2 + sampler.tight * norm(v) * norm(d) + 1e-30:
                return f"from {a} to {b}"
    return ""


def onto_boundary(model: Any, a: Point, sampler: Sampler) -> tuple[Point, list[Any]]:
    """A point near where a row of C is 0 and all others are not < 0, and the row's gradient; [] where there is none."""
    for _ in range(60):
        rows = model["C"].values(a)
        low = min(rows, key=lambda row: row.v)
        if abs(low.v) <= sampler.bare and any(low.g):
            return a, low.g
        if not any(low.g):
            break
        a = [x - low.v / norm(low.g) ** 2 * d for x, d in zip(a, low.g, strict=True)]
    return a, []


def dissipative(model: Any, statement: Any, sampler: Sampler) -> str:
    alpha, beta = (sampler.real(statement["value"][name]) for name in ("alpha", "beta"))
    if alpha <= 0:
        return "alpha <= 0"
    for k, (a, _) in enumerate(sampler.pairs(model["F"].inputs)):
        size = norm(a) ** 2
        if inside(model, a) > 0 and dot(a, drift(model, a)) > -alpha * size + beta + SLACK * (1 + abs(beta) + size):
            return f"at {a}"
        if model["C"].data["outputs"] and k < 6:
            a, normal = onto_boundary(model, a, sampler)
            v = drift(model, a)
            if normal and (out := dot(normal, v)) < 0:
                w, size = [x - out / norm(normal) ** 2 * y for x, y in zip(v, normal, strict=True)], norm(a) ** 2
                if dot(a, w) > -alpha * size + beta + 1e-6 * (1 + abs(beta) + size):
                    return f"at {a}, on the boundary"
    return not_convex(model["C"], sampler.whole(), -1)


FINDERS: dict[str, Callable[[Any, Any, Sampler], str]] = {
    "S-convex": s_convex, **dict.fromkeys(("A0", "A1", "A2", "A3", "A4"), regular), "A5": qualified, "A5'": qualified,
    "S-f": velocity, "S-start": start, "O-theta": friction, "O-g": potential, "O-dry": dry, "O-steps": steps_grow,
    "F-jacobians": smooth, "F-step": step_bound, "F-W": step_bound, "F-mlcp": mlcp, "F-unique": mlcp, "3.1": thin_law,
    "4.1": feedthrough, "5.1": no_storage, "5.2": grows, **dict.fromkeys(("5.4a", "5.4b", "5.4c", "5.x0"), one_range),
    "7.1": not_at_rest, "M-T": monotone, "M-C": bad_set, "M-A1": without_value, "M-A2": linear_growth, "M-A3": dissipative,
    "M-24": one_sided,
}  # fmt: skip
EXACT = (start, steps_grow, thin_law, feedthrough, no_storage, not_at_rest)  # At once with 50 digits, or in fractions.
