"""Verify a certificate of ``nsmodel check --certificate``: python verify.py certificate.json

This file needs nothing but Python. Each statement is proved anew from the model's data, in fractions; the certificate's hints
(matrices, vectors, covers of boxes) serve where they can be checked. The answer is "yes", "no", or "not checkable: reason".
A graph is a straight-line program: steps ["in", k], ["const", c], ["add", i, j], ["mul", i, j], ["pow", i, exponent],
["fmax", i, j], ["exp", i], ["sin", i], ["cos", i], where i and j are numbers of earlier steps.
"""

import hashlib, json, math, sys
from fractions import Fraction as Q
from itertools import pairwise, product

BITS = 80  # Intervals are rounded outwards to so many bits.
HALF, PI = Q("1/2"), Q("3.14159265358979323846264338327950288")  # to 1e-35

class NotCheckable(Exception): """What this file does not know how to verify."""
class Undefined(Exception): """An operation may be undefined, or jump, on an interval."""
def need(true, text, error=AssertionError):
    if not true:
        raise error(text)

def numbers(item):
    """Fractions of text, in lists and dictionaries; infinities stay floats."""
    if isinstance(item, dict):
        return {name: numbers(part) for name, part in item.items()}
    if isinstance(item, list):
        return [numbers(part) for part in item]
    return float(item) if item in ("inf", "-inf") else Q(item)

# -- linear algebra: matrices are lists of rows
def transpose(A): return [list(row) for row in zip(*A, strict=True)]
def dot(a, b): return sum((x * y for x, y in zip(a, b, strict=True) if x and y), Q(0))
def times(A, B): return [[dot(row, column) for column in transpose(B)] for row in A]
def plus(A, B, factor=1): return [[a + factor * b for a, b in zip(r, s, strict=True)] for r, s in zip(A, B, strict=True)]
def eye(n, entry=1): return [[Q(entry) if i == j else Q(0) for j in range(n)] for i in range(n)]
def psd(M, definite=False):
    """Whether M + M' is positive semidefinite (or definite): its LDL' factorisation with the largest pivots first."""
    S, left = plus(M, transpose(M)), list(range(len(M)))
    while left:
        k = max(left, key=lambda i: S[i][i])
        if S[k][k] <= 0:
            return not definite and all(S[i][j] == 0 for i in left for j in left)
        left.remove(k)
        for i in left:
            factor = S[i][k] / S[k][k]
            for j in left if factor else ():
                S[i][j] -= factor * S[k][j]
    return True

def nonnegative(p, low=Q(0), high=Q(1), strictly=False, depth=60):
    """p >= 0 (or > 0) on [low, high]: Bernstein's coefficients are, on it or on both halves."""
    n, c = len(p), [Q(0)] * len(p)
    for k, a in enumerate(p):  # (1 + u)^(n-1) p((low + high u)/(1 + u))
        for i, j in product(range(k + 1), range(n - k)):
            c[i + j] += a * math.comb(k, i) * low ** (k - i) * high**i * math.comb(n - 1 - k, j)
    ends, middle = min(c[0], c[-1]), (low + high) / 2
    if min(c) >= 0 and not (strictly and ends == 0) or depth == 0 or ends < 0:
        return min(c) >= 0 and not (strictly and ends == 0)
    return all(nonnegative(p, x, y, strictly, depth - 1) for x, y in ((low, middle), (middle, high)))

# -- intervals
def rounded(x, up=False):
    """x rounded down or up to BITS bits."""
    n, d, shift = x.numerator, x.denominator, BITS - x.numerator.bit_length() + x.denominator.bit_length()
    if not n or (d & (d - 1) == 0 and n.bit_length() <= BITS):
        return x
    over, under = (n << shift, d) if shift > 0 else (n, d << -shift)
    whole = -(-over // under) if up else over // under
    return Q(whole, 1 << shift) if shift > 0 else Q(whole << -shift)

class Interval:
    """lo <= x <= hi, both fractions; operations round outwards. Functions raise Undefined where they may have no value."""
    def __init__(self, lo, hi=None, slack=0):
        self.lo, self.hi = rounded(Q(lo) - slack), rounded(Q(lo if hi is None else hi) + slack, True)

    def __add__(self, other): return Interval(self.lo + other.lo, self.hi + other.hi)
    def __neg__(self): return Interval(-self.hi, -self.lo)
    def __mul__(self, other):
        ends = [a * b for a in (self.lo, self.hi) for b in (other.lo, other.hi)]
        return Interval(min(ends), max(ends))
    def scaled(self, c): return self * Interval(c)
    def within(self, bound): return -bound <= self.lo and self.hi <= bound
    def power(self, n):
        """x^n for n = -2, -3/2, -1, ..."""
        if n.denominator == 2:
            return Interval(root(self.lo).lo, root(self.hi).hi).power(2 * n)
        need(n.denominator == 1, f"the power {n}", NotCheckable)
        need(n >= 0 or not self.lo <= 0 <= self.hi, "a division by an interval around 0", Undefined)
        if n < 0:
            return Interval(1 / self.hi, 1 / self.lo).power(-n)
        ends = sorted((self.lo**n, self.hi**n))
        return Interval(0 if n and n % 2 == 0 and self.lo < 0 < self.hi else ends[0], ends[1])
    def exp(self): return Interval(exp(self.lo).lo, exp(self.hi).hi)
    def sin(self, quarters=0):
        """sin(x + quarters pi/2): the value in the middle, and the slope 1."""
        if self.lo == self.hi == 0:
            return Interval(quarters)
        middle, half = (self.lo + self.hi) / 2 + quarters * PI / 2, (self.hi - self.lo) / 2
        k = round(middle / PI)
        y, total = rounded(middle - k * PI), Q(0)
        term = -y if k % 2 else y
        for i in range(1, 36, 2):
            total, term = total + term, rounded(-term * y * y / ((i + 1) * (i + 2)))
        found = Interval(total, slack=half + Q(abs(k) + 2, 2**70))
        return Interval(max(found.lo, Q(-1)), min(found.hi, Q(1)))

def root(x):
    need(x >= 0, "a root of what may be negative", Undefined)
    shift = max(0, BITS - (x.numerator.bit_length() - x.denominator.bit_length()) // 2)
    low = Q(math.isqrt((x.numerator << 2 * shift) // x.denominator), 1 << shift)
    return Interval(low, low if low * low == x else low + Q(1, 1 << shift))

def exp(x):
    """exp(x / 2^k)^(2^k), Taylor's polynomial on [-1/2, 1/2]."""
    k, total, term = math.ceil(abs(x)).bit_length() + 1, Q(1), Q(1)
    need(k <= 12, "exp of a large number")
    for i in range(1, 26):
        term = rounded(term * x / 2**k / i)
        total += term
    value = Interval(total, slack=Q(int(x != 0), 2**76))
    for _ in range(k):
        value = value * value
    return value

FUNCTIONS = {  # f(x), f'(x), f''(x)
    "exp": lambda x: (x.exp(), x.exp(), x.exp()),
    "sin": lambda x: (x.sin(), x.sin(1), -x.sin()),
    "cos": lambda x: (x.sin(1), -x.sin(), -x.sin(1)),
}

def length(row): return sum((x.power(Q(2)) for x in row), Interval(0)).power(HALF)
# -- graphs
def run(graph, inputs, const, apply):
    """The outputs in an algebra with + and *; ``apply(op, u, w)`` does the other operations, w the second argument."""
    nodes = []
    for op, i, *j in graph["steps"]:
        w = nodes[j[0]] if op in ("add", "mul", "fmax") else Q(j[0]) if j else None
        nodes.append(inputs[i] if op == "in" else const(Q(i)) if op == "const" else nodes[i] + w if op == "add"
                     else nodes[i] * w if op == "mul" else apply(op, nodes[i], w))
    return [nodes[k] for k in graph["outputs"]]

class Jet:
    """Value, gradient and Hessian on a box, in intervals; gradient and Hessian may be left out."""
    def __init__(self, v, g, H):
        self.v, self.g, self.H = v, g, H
    def __add__(self, o):
        return Jet(self.v + o.v, [a + b for a, b in zip(self.g, o.g, strict=True)],
                   [[a + b for a, b in zip(r, s, strict=True)] for r, s in zip(self.H, o.H, strict=True)])
    def __mul__(self, o):
        n, g = range(len(self.H)), [self.v * b + o.v * a for a, b in zip(self.g, o.g, strict=True)]
        return Jet(self.v * o.v, g, [[self.v * o.H[i][j] + o.v * self.H[i][j] + self.g[i] * o.g[j] + self.g[j] * o.g[i]
                                      for j in n] for i in n])
    def chain(self, f, d, dd):
        n = range(len(self.H))
        return Jet(f, [d * a for a in self.g], [[dd * self.g[i] * self.g[j] + d * self.H[i][j] for j in n] for i in n])
    def larger(self, o):
        """fmax; where it is not settled the hull of both, without second derivatives."""
        if self.v.lo >= o.v.hi or o.v.lo >= self.v.hi:
            return self if self.v.lo >= o.v.hi else o
        need(not self.H, "a kink", Undefined)
        g = [Interval(min(a.lo, b.lo), max(a.hi, b.hi)) for a, b in zip(self.g, o.g, strict=True)]
        return Jet(Interval(max(self.v.lo, o.v.lo), max(self.v.hi, o.v.hi)), g, [])

def jets(graph, box, order=2, wrt=None):
    """The Jet of each output; derivatives up to ``order`` by the inputs ``wrt`` (None: all)."""
    own = list(range(len(graph["inputs"])) if wrt is None else wrt)
    zero = [Interval(0)] * len(own) if order else []
    flat = [zero] * len(own) if order > 1 else []
    def apply(op, u, w):
        if op in FUNCTIONS:
            return u.chain(*FUNCTIONS[op](u.v))
        if op == "pow":
            first = u.v.power(w - 1).scaled(w) if order else None
            return u.chain(u.v.power(w), first, u.v.power(w - 2).scaled(w * (w - 1)) if order > 1 else None)
        return u.larger(w) if op == "fmax" else need(False, f"no operation {op}")
    inputs = [Jet(x, [Interval(int(k == i)) for i in own] if order else [], flat) for k, x in enumerate(box)]
    return run(graph, inputs, lambda c: Jet(Interval(c), zero, flat), apply)

def cover(tree, box, leaf):
    """Whether ``leaf`` holds on each part: a tree [coordinate, left, right] halves the box; anything else is a hint."""
    if isinstance(tree, list) and len(tree) == 3 and isinstance(tree[0], int):
        k, middle = tree[0], (box[tree[0]].lo + box[tree[0]].hi) / 2
        sides = Interval(box[k].lo, middle), Interval(middle, box[k].hi)
        return all(cover(part, [*box[:k], side, *box[k + 1 :]], leaf) for part, side in zip(tree[1:], sides, strict=True))
    return bool(leaf(box, tree))

def interval_psd(H):
    """A symmetric interval matrix is psd where its middle is, less the size of the radii."""
    radii = sum((((a.hi - a.lo) / 2) ** 2 for row in H for a in row), Q(0))
    return psd(plus([[(a.lo + a.hi) / 2 for a in row] for row in H], eye(len(H), root(radii).hi), -1))

def norm_below(J, K):
    """|J| <= K for an interval matrix: [K, J; J', K] is psd."""
    m, n, k, zero = len(J), len(J[0]), Interval(K), Interval(0)
    rows = [[k if i == j else zero for j in range(m)] + J[i] for i in range(m)]
    return interval_psd(rows + [[J[i][j] for i in range(m)] + [k if j == l else zero for l in range(n)] for j in range(n)])

# -- polynomials in the inputs 0, 1, ... and in atoms, {monomial: coefficient}
class Poly(dict):
    """A monomial is a tuple of (variable, power)."""
    def __add__(self, o):
        out = dict(self)
        for m, a in o.items():
            out[m] = out.get(m, Q(0)) + a
        return Poly({m: a for m, a in out.items() if a})
    def __neg__(self): return self.scaled(-1)
    def scaled(self, c): return Poly({m: a * c for m, a in self.items() if c})
    def number(self): return self.get((), Q(0)) if set(self) <= {()} else None
    def __mul__(self, o):
        out = Poly()
        for (m, a), (k, b) in product(self.items(), o.items()):
            powers = dict(m)
            for v, n in k:
                powers[v] = powers.get(v, 0) + n
            out += Poly({tuple(sorted(powers.items())): a * b})
        return out

def constant(c): return Poly({(): Q(c)} if c else {})
def variable(v, c=1): return Poly({((v, 1),): Q(c)} if c else {})

class Atoms:
    """Each operation that is no polynomial is a new variable, the same for the same operation on the same polynomials."""
    def __init__(self):
        self.known, self.meaning = {}, {}
    def of(self, op, *args):
        key = (op, *(tuple(sorted(p.items())) if isinstance(p, Poly) else p for p in args))
        v = self.known.setdefault((op, *sorted(key[1:])) if op == "fmax" else key, 10**6 + len(self.known))
        self.meaning[v] = (op, *args)
        return variable(v)
    def apply(self, op, u, w):
        if op == "pow" and w.denominator == 1 and (u.number() or 0 <= w <= 16):
            return constant(u.number() ** w) if u.number() else math.prod([u] * int(w), start=constant(1))
        return self.of(op, u, *([] if w is None else [w]))
    def read(self, graph):
        return run(graph, [variable(k) for k in range(len(graph["inputs"]))], constant, self.apply)
    def inputs(self, *polys):
        """The inputs that polynomials depend on, through atoms too."""
        own = {v for p in polys for m in p for v, _ in m}
        inner = [part for v in own if v in self.meaning for part in self.meaning[v][1:] if isinstance(part, Poly)]
        return {v for v in own if v not in self.meaning} | (self.inputs(*inner) if inner else set())

def affine(p, own, atoms):
    """(row, rest): p = row . own + rest, the rest free of these inputs; None where it is not so."""
    row, rest = [Q(0)] * len(own), Poly()
    for m, a in p.items():
        if not atoms.inputs(Poly({m: a})) & set(own):
            rest[m] = a
        elif len(m) == 1 and m[0][0] in own and m[0][1] == 1:
            row[own.index(m[0][0])] = a
        else:
            return None
    return row, rest

def gram(p, own):
    """The symmetric G with p = (v, 1)'G(v, 1), v the variables ``own``; None where p is no such quadratic."""
    n = len(own)
    G = [[Q(0)] * (n + 1) for _ in range(n + 1)]
    for m, a in p.items():
        if not all(v in own for v, _ in m) or sum(k for _, k in m) > 2:
            return None
        i, j = ([own.index(v) for v, k in m for _ in range(k)] + [n, n])[:2]
        G[i][j] += a / 2
        G[j][i] += a / 2
    return G

def convex(p, own, atoms):
    """By the rules of convex functions: a psd quadratic, and even powers and convex atoms weighted >= 0."""
    quadratic = Poly()
    for m, a in p.items():
        inner = [(v, n) for v, n in m if atoms.inputs(variable(v)) & set(own)]
        if inner and all(v in own for v, _ in m) and sum(n for _, n in m) <= 2:
            quadratic[m] = a
        elif inner and not (len(m) == 1 and a > 0 and bends(*inner[0], own, atoms)):
            return False
    G = gram(quadratic, own)
    return G is not None and psd([row[:-1] for row in G[:-1]])

def bends(v, n, own, atoms):
    """Whether v^n is convex: an even power, the larger of two convex ones, exp of one, the norm of an affine map."""
    if v in own:
        return n % 2 == 0
    op, u, *more = atoms.meaning[v]
    if n > 1 and not positive(v, atoms):
        return False
    if op == "pow" and more[0] == HALF:
        G = gram(u, sorted({w for m in u for w, _ in m}))
        return G and psd(G) and not any(w in atoms.meaning and atoms.inputs(variable(w)) & set(own) for m in u for w, _ in m)
    return op in ("fmax", "exp") and all(convex(p, own, atoms) for p in (u, *more))

def positive(v, atoms):
    op, u, *more = atoms.meaning[v]  # a root, exp, |u| = fmax(u, -u)
    return op == "exp" or (op == "pow" and more[0] == HALF) or (op == "fmax" and u == -more[0])

# -- statements: each proves one hypothesis of the model m; s has the numbers, the scope and the hints
def box_of(names, s, *graphs):
    """The scope's intervals of some inputs; 0 where no step of the graphs looks at one."""
    used = {step[1] for graph in graphs for step in graph["steps"] if step[0] == "in"} if graphs else range(len(names))
    own = {**((s["scope"] or {}).get("states") or {}), "t": (s["scope"] or {}).get("time")}
    need(all(own.get(names[k]) for k in used), "this form of proof needs a box", NotCheckable)
    return [Interval(*numbers(own[name])) if k in used else Interval(0) for k, name in enumerate(names)]

def on_cover(graph, s, tree, order, leaf, wrt=None):
    """``leaf(jets)`` on each part of the scope's box."""
    box = box_of(graph["inputs"], s, graph)
    need(cover(tree, box, lambda part, _: leaf(jets(graph, part, order, wrt))), "a bound fails on a part")

class Shape:
    """A constraint g(t, q_1, ..., q_k): the forms "affine" and "norm", w |A q + c(t)| + offset(t), are proved here.

    With "box" [low, high]: w |q - min(max(q, low), high)| + offset(t), the distance to a box.
    """
    def __init__(self, c, hint, s):
        self.graph, self.hint, self.s, self.atoms, self.form = c["graph"], hint, s, Atoms(), hint["form"]
        self.own, self.delta = [*range(1, len(c["graph"]["inputs"]))], Q(c.get("delta", 0))
        (self.p,) = self.atoms.read(self.graph)
        if self.form == "affine":
            self.row, self.offset = affine(self.p, self.own, self.atoms) or need(False, "g is not affine")
            self.centre, self.hint = [], {**hint, "c": [], "offset": self.graph}
        elif self.form == "norm":
            self.A, self.w = numbers(hint["A"]), Q(hint["w"])
            *self.centre, self.offset = (self.atoms.read(part)[0] for part in [*hint["c"], hint["offset"]])
            need(self.w > 0 and self.atoms.inputs(*self.centre, self.offset) <= {0}, "c or the offset holds states")
            u = [sum(map(variable, self.own, row), c) for row, c in zip(self.A, self.centre, strict=True)]
            if "box" in hint:
                need(self.A == eye(len(self.own)) and not any(self.centre), "q has other coordinates")
                u = [x + self.atoms.of("fmax", -self.atoms.of("fmax", x, constant(a)), constant(-b))
                     for x, (a, b) in zip(u, numbers(hint["box"]), strict=True)]
            norm = self.atoms.of("pow", sum((x * x for x in u), constant(0)), HALF)
            need(self.p == norm.scaled(self.w) + self.offset, "g is not w |A q + c| + offset")
    def in_time(self, leaf):
        """``leaf(|c'|, offset', offset)`` at all times of the scope."""
        if not self.atoms.inputs(*self.centre, self.offset):
            return need(leaf(Interval(0), Interval(0), Interval(self.offset.number() or 0)), "a bound fails")
        def part(box, _):
            rest = [Interval(0)] * len(self.own)  # of an affine g the offset is its value where q = 0
            found = [jets(g, (box + rest)[: len(g["inputs"])], 1, [0])[0] for g in [*self.hint["c"], self.hint["offset"]]]
            return leaf(length([j.g[0] for j in found[:-1]]), found[-1].g[0], found[-1].v)
        need(cover(self.hint.get("time"), box_of(["t"], self.s), part), "a bound fails at some time")

def shapes(m, s): return [Shape(c, hint, s) for c, hint in zip(m["constraints"], s["proof"]["constraints"], strict=True)]
def s_convex(m, s):
    for c in shapes(m, s):  # a norm of an affine map, and the distance to a box, are convex
        if c.form == "box":
            on_cover(c.graph, s, c.hint["cover"], 2, lambda found: interval_psd(found[0].H), c.own)
        need(c.form != "rules" or convex(c.p, c.own, c.atoms), "not convex by the rules")

NEEDED = {"A0": (), "A1": ("a", "b"), "A2": ("speed",), "A3": ("turn",), "A4": ("M", "M_contact")}
def regular(m, s):
    """A0 to A4: a <= |grad g| <= b, |d_t g| <= speed, |d_t grad g| <= turn, |D^2 g| <= M on {g > -delta}, M_contact on {g >= 0}.
    c = delta / b is the distance of the boundary of {g > -delta}; a number that is not given is not looked at.
    """
    need(all(name in s["value"] for name in NEEDED[s["id"]]), "a number is missing")
    most = {**dict.fromkeys(("b", "speed", "turn", "M", "M_contact"), Q(10) ** 400), "a": Q(0), "c": Q(0), **numbers(s["value"])}
    a, b, speed, turn, M, near, far = (most[name] for name in ("a", "b", "speed", "turn", "M", "M_contact", "c"))
    need(min(turn, M, near) >= 0 and (a > 0 or "a" not in s["value"]), "a number has the wrong sign")
    for c in shapes(m, s):
        if c.form == "affine":
            need(a * a <= dot(c.row, c.row) <= b * b, "a or b")
            c.in_time(lambda _, rate, offset: rate.within(speed))
            continue
        delta, steep = c.delta, Q(c.hint["b"])
        need(0 < delta and steep <= b and far * steep <= delta, "delta, b or c")
        if c.form == "norm":  # grad g = w A'n, |n| = 1; D^2 g = w^2 A'(1 - nn')A / (g - offset)
            reach, AA = Q(c.hint["reach"]), times(c.A, transpose(c.A))
            unit = eye(len(AA), 1 / c.w**2)
            need(delta < reach and psd(plus(AA, unit, -a * a)) and psd(plus(eye(len(AA), (steep / c.w) ** 2), AA, -1)), "a or b")
            need(steep**2 <= M * (reach - delta) and steep**2 <= near * reach, "M")
            c.in_time(lambda rate, moving, offset, w=c.w, k=steep, r=reach, d=delta: offset.hi <= -r
                      and w * k * rate.hi <= turn * (r - d) and w * rate.hi + max(-moving.lo, moving.hi) <= speed)
        else:
            def leaf(found, delta=delta, steep=steep):
                (g,), n = found, range(1, len(found[0].g))
                size, H = length(g.g[1:]), [[g.H[i][k] for k in n] for i in n]
                return g.v.hi <= -delta or (a <= size.lo and size.hi <= steep and g.g[0].within(speed) and norm_below(H, M)
                    and length([g.H[0][i] for i in n]).hi <= turn and (g.v.hi < 0 or norm_below(H, near)))
            on_cover(c.graph, s, c.hint["cover"], 2, leaf)

def qualified(m, s):
    """A direction d on each part with <grad g, d> >= |grad g| |d| / gamma for the g that may be <= rho."""
    gamma, rho, names = Q(s["value"]["gamma"]), Q(s["value"].get("rho", 0)), m["f"]["inputs"]
    need(gamma >= 1 and (len(m["constraints"]) < 2 or s["id"] == "A5'" or "rho" in s["value"]), "gamma < 1, or no rho")
    def leaf(box, d):
        own = dict(zip(names, box, strict=True))
        found = [(c, jets(c["graph"], [own[name] for name in c["graph"]["inputs"]], 1)[0]) for c in m["constraints"]]
        close = [(c, g) for c, g in found if g.v.lo <= rho]
        if len(close) <= 1 or any(g.v.hi < 0 for _, g in found):
            return True
        d = dict(zip(names[1:], numbers(d), strict=True))
        along = [sum((x.scaled(d[v]) for x, v in zip(g.g, c["graph"]["inputs"], strict=True) if v != "t"), Interval(0))
                 for c, g in close]
        size = length([Interval(x) for x in d.values()])
        return all(x.lo * gamma >= (length(g.g[1:]) * size).hi for x, (_, g) in zip(along, close, strict=True))
    graphs = [c["graph"] for c in m["constraints"]]
    used = {"steps": [["in", names.index(g["inputs"][k])] for g in graphs for op, k, *_ in g["steps"] if op == "in"]}
    need(len(graphs) <= 1 or cover(s["proof"]["cover"], box_of(names, s, used), leaf), "gamma fails on a part")

def velocity(m, s):
    f, atoms, own, value = m["f"], Atoms(), list(range(1, len(m["f"]["inputs"]))), numbers(s["value"])
    found, K, L = [affine(p, own, atoms) for p in atoms.read(f)], value["K_f"], value["L_f"]
    def small(j, far=Q(0)):
        rate = length([x.g[0] for x in j]).hi
        return length([x.v for x in j]).hi <= L * (1 + far) and rate <= value.get("L_t", rate)
    if all(found):
        need(norm_below([[Interval(x) for x in row] for row, _ in found], K) and L >= K, "K_f")
        time = box_of(["t"], s) if atoms.inputs(*(rest for _, rest in found)) else [Interval(0)]
        part = lambda box, _: small(jets(f, box + [Interval(0)] * len(own), 1, [0]))  # noqa: E731
        return need(cover(s["proof"].get("time"), time, part), "L_f or L_t")
    part = lambda box, _: small(j := jets(f, box, 1), length(box[1:]).lo) and norm_below([x.g[1:] for x in j], K)  # noqa: E731
    need(cover(s["proof"]["cover"], box_of(f["inputs"], s, f), part), "K_f, L_f or L_t")

def start(m, s):
    q0 = dict(zip(m["f"]["inputs"][1:], numbers(m["q0"]), strict=True))
    for c in m["constraints"]:
        (g,) = jets(c["graph"], [Interval(0), *(Interval(q0[name]) for name in c["graph"]["inputs"][1:])], 0)
        need(g.v.lo >= 0, "g < 0 at the start, or too near to 0")

def law(m):
    """(lower, upper) of each multiplier of a Lur'e system."""
    need(all(block["kind"] == "box" for block in m["law"]), "a law that is no box", NotCheckable)
    return [ends for block in m["law"] for ends in zip(numbers(block["lower"]), numbers(block["upper"]), strict=True)]

def storage(m, s):
    P, B, C = (numbers(part) for part in (s["proof"]["P"], m["B"], m["C"]))
    need(P == transpose(P) and psd(P, True), "P is not symmetric and positive definite")
    need(times(P, B) == transpose(C), "P B = C' fails")
    return P

def growth(m, s):
    P, atoms = storage(m, s), Atoms()
    rows = [affine(p, list(range(len(P))), atoms) for p in atoms.read(m["A"])]
    need(all(row and not row[1] for row in rows), "A is not linear", NotCheckable)
    need(psd(plus([[Q(s["value"]["omega"]) * x for x in row] for row in P], times(P, [row for row, _ in rows]), -1)), "omega")

def everything(m):
    """Whether the range of D + dXi is the whole space: K bounded, or D + D' > 0."""
    return all(abs(end) < math.inf for ends in law(m) for end in ends) or psd(numbers(m["D"]), True)

def in_range(m, s, x=None):
    """C x = D'k + y + (D + D')v, k and y inside: y > 0 where l has no upper end, 0 at an end where l is bounded is no limit."""
    if everything(m):
        return
    C, D, p, column = numbers(m["C"]), numbers(m["D"]), numbers(s["proof"]), lambda v: [[entry] for entry in v]
    right = plus(plus(times(transpose(D), column(p["k"])), column(p["y"])), times(plus(D, transpose(D)), column(p["v"])))
    need(psd(D) and times(C, column(p["x"] if x is None else x)) == right, "C x = D'k + y + S v fails")
    for (low, high), k, y in zip(law(m), p["k"], p["y"], strict=True):
        free = (low > -math.inf) + 2 * (high < math.inf)
        need(low < k < high and (free == 3 or (free == 1 and y > 0) or (free == 2 and y < 0)), "k or y is not inside")

def at_rest(m, s):
    in_range(m, s, [Q(0)] * len(m["x0"]))
    zero = all(x.v.lo == 0 == x.v.hi for x in jets(m["A"], [Interval(0)] * len(m["x0"]), 0)) and not any(Atoms().read(m["f"]))
    need(zero and all(a <= 0 <= b for a, b in law(m)), "A(0) or f is not 0, or 0 is not in K")

def selection(m):
    """F - S = A x + b - sum w l a, l in Sgn(a'x + c), read off F, S or phi: A, b, [(w, a, c)]."""
    atoms, n, switches = Atoms(), list(range(len(m["x0"]))), []
    rows = [affine(p, n, atoms) for p in atoms.read(m["F"])]
    minus = [affine(p, n, atoms) for p in atoms.read(m["S"])] if m["S"] else []
    need(all(row and row[1].number() is not None for row in rows + minus), "F or S is not affine", NotCheckable)
    A, b = [row for row, _ in rows], [rest.number() for _, rest in rows]
    if minus:
        A, b = plus(A, [row for row, _ in minus], -1), [x - rest.number() for x, (_, rest) in zip(b, minus, strict=True)]
    for m_, a in (atoms.read(m["phi"])[0] if m["phi"] else Poly()).items():
        G = gram(Poly({m_: a}), n)
        if G:
            A, b = plus(A, [row[:-1] for row in G[:-1]], -2), [x - 2 * row[-1] for x, row in zip(b, G[:-1], strict=True)]
        elif len(m_) == 1 and m_[0][1] == 1 and atoms.meaning[m_[0][0]][0] == "fmax" and positive(m_[0][0], atoms) and a >= 0:
            row, c = affine(atoms.meaning[m_[0][0]][1], n, atoms) or need(False, "|.| of no affine function")
            switches.append((a, row, c.number()))
        else:
            raise NotCheckable("phi has a term that is neither quadratic nor |affine|")
    return A, b, switches

def monotone(m, s):
    atoms, n = Atoms(), list(range(len(m["x0"])))
    if m["phi"]:
        return need(convex(atoms.read(m["phi"])[0], n, atoms), "phi is not convex by the rules")
    rows = [affine(p, n, atoms) for p in atoms.read(m["S"])] if m["S"] else []
    need(not all(rows) or psd([row for row, _ in rows]), "S is not monotone")
    if not all(rows):
        on_cover(m["S"], s, s["proof"]["cover"], 1, lambda j: interval_psd([[j[a].g[b] + j[b].g[a] for b in n] for a in n]))

def set_with_interior(m, s, origin=False):
    """C is convex, and a point is inside; or 0 is in C."""
    atoms, n = Atoms(), list(range(len(m["C"]["inputs"])))
    need(all(convex(-p, n, atoms) for p in atoms.read(m["C"])), "a row is not concave by the rules")
    point = [Interval(x) for x in ([0] * len(n) if origin else numbers(s["proof"]["interior"]))]
    need(all(g.v.lo > 0 or (origin and g.v.lo == 0) for g in jets(m["C"], point, 0)), "the point is not inside")

def smooth(m, s, names="F", order=0):
    """Operations that are continuous (or twice differentiable) everywhere, else values (or Hessians) on a cover."""
    for graph in (m[name] for name in names):
        if not all(op in ("in", "const", "add", "mul", "exp", "sin", "cos") or (op == "fmax" and not order)
                   or (op == "pow" and Q(rest[1]) >= 0 and Q(rest[1]).denominator == 1) for op, *rest in graph["steps"]):
            on_cover(graph, s, s["proof"].get("cover"), order, lambda found: True)

def linear_growth(m, s):
    A, b, switches = selection(m)
    need(norm_below([[Interval(x) for x in row] for row in A], Q(s["value"]["a_2"])) and len(switches) <= 12, "a_2")
    for signs in product((-1, 1), repeat=len(switches)):
        v = [x + sum(e * w * a[i] for e, (w, a, _) in zip(signs, switches, strict=True)) for i, x in enumerate(b)]
        need(dot(v, v) <= Q(s["value"]["a_1"]) ** 2, "a_1")

def dissipative(m, s):
    """0 in C, and alpha |x|^2 + x'Ax + b'x + sum w |c| <= beta, as -l a'x <= |c|; projections on T_C do no harm."""
    (A, b, switches), alpha, beta = selection(m), Q(s["value"]["alpha"]), Q(s["value"]["beta"])
    set_with_interior(m, s, origin=True)
    need(alpha > 0, "alpha <= 0")
    rows = [[-x for x in row] + [-y] for row, y in zip(plus(A, eye(len(b)), alpha), b, strict=True)]
    need(psd([*rows, [Q(0)] * len(b) + [beta - sum(w * abs(c) for w, _, c in switches)]]), "beta")

def theta_of(graph):
    p = Atoms().read(graph)[0]
    need(all(v == 0 and k <= 16 for m in p for v, k in m), "theta is no polynomial", NotCheckable)
    return [p.get(((0, k),) if k else (), Q(0)) for k in range(17)]

def friction(m, s):
    for c in map(theta_of, m["theta"]):
        first = [k * a for k, a in enumerate(c)][1:]
        for p in (first, [k * a for k, a in enumerate(first)][1:]):  # p >= 0 on [0, inf): p and its reverse are, on [0, 1]
            need(nonnegative(p) and nonnegative(p[::-1]), "theta' or theta'' < 0")
    need(psd(numbers(m["damping"])), "the damping is not psd")

def potential(m, s):
    atoms, n = Atoms(), list(range(len(m["g"]["inputs"])))
    (p,) = atoms.read(m["g"])
    need(convex(p, n, atoms), "g is not convex by the rules")
    set_with_interior(m, s)
    left_out = [k for k, a in p.items() if len(k) == 1 and a > 0 and k[0][0] in atoms.meaning and positive(k[0][0], atoms)]
    G = gram(Poly({k: a for k, a in p.items() if k not in left_out}), n) or need(False, "terms of no known sign")
    G[-1][-1] -= Q(s["value"]["lower bound of g"])
    need(psd(G), "inf g")

def dry(m, s):
    total = eye(len(m["g"]["inputs"]), -(Q(s["value"]["radius of A(0)"]) ** 2))
    for r, H in zip((theta_of(graph)[1] for graph in m["theta"]), numbers(m["H"]), strict=True):
        total = plus(total, times(transpose(H), H), max(r, Q(0)) ** 2)
    need(psd(total) and Q(s["value"]["radius of A(0)"]) > 0, "the radius")

def step(m, s):
    """1 - s X is regular for 0 <= s <= h, X = M^-1 (theta f_x + gamma g_x): h |X| < 1 on a cover, or by its determinant."""
    atoms, n, h, theta, gamma = Atoms(), len(m["x0"]), Q(s["value"]["h"]), Q(m["theta"]), Q(m["gamma"])
    f, g = ([affine(p, list(range(1, n + 1)), atoms) for p in atoms.read(m[name])] for name in "fg")
    inverse, c, power = numbers(s["proof"]["inverse"]), [Q(1)], eye(n)
    need(times(numbers(m["M"]), inverse) == eye(n) and h >= Q(m["step"]), "M has another inverse, or h is not the step")
    if not all(f + g):
        def small(box, _):
            F, G = (jets(m[name], box, 1, range(1, n + 1)) for name in "fg")
            X = [[sum((F[l].g[k].scaled(theta * row[l]) + G[l].g[k].scaled(gamma * row[l]) for l in range(n)), Interval(0))
                  for k in range(n)] for row in inverse]
            return norm_below(X, (1 - Q(1, 2**30)) / h)
        return need(cover(s["proof"]["cover"], box_of(m["f"]["inputs"], s, m["f"], m["g"]), small), "h |X| < 1 fails")
    X = times(inverse, [[theta * x + gamma * y for x, y in zip(a, b, strict=True)] for (a, _), (b, _) in zip(f, g, strict=True)])
    for k in range(1, n + 1):
        power = times(X, power)
        c.append(-sum(power[i][i] for i in range(n)) / k)
        power = plus(power, eye(n), c[-1])
    need(nonnegative(c, Q(0), h, strictly=True), "the determinant has a root")  # by Faddeev and LeVerrier

STATEMENTS = {
    "S-convex": s_convex, **dict.fromkeys(NEEDED, regular), "A5": qualified, "A5'": qualified, "S-f": velocity, "S-start": start,
    "3.1": lambda m, s: need(all(a < b for a, b in law(m)), "K has no interior"), "5.1": storage, "5.2": growth,
    "4.1": lambda m, s: need((x := Q(s["value"]["least"])) >= 0 and psd(plus(numbers(m["D"]), eye(len(m["D"]), -x))), "D"),
    "5.4a": in_range, "5.4b": lambda m, s: need(everything(m) or psd(numbers(m["D"])), "D"), "5.4c": in_range,
    "5.x0": lambda m, s: in_range(m, s, numbers(m["x0"])), "7.1": at_rest, "M-T": monotone, "M-C": set_with_interior,
    "M-A1": smooth, "M-A2": linear_growth, "M-A3": dissipative,
    "M-24": lambda m, s: need(psd(plus(eye(len(m["x0"]), Q(s["value"]["L"])), selection(m)[0], -1)), "L"),
    "O-theta": friction, "O-g": potential, "O-dry": dry,
    "O-steps": lambda m, s: need(all(0 < x <= y for x, y in pairwise(numbers([m["steps"][0], *m["steps"]]))), "a step shrinks"),
    "F-jacobians": lambda m, s: smooth(m, s, "fgh", 2), "F-step": step, "F-W": step,
}

def digest(model): return hashlib.sha256(json.dumps(model, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
def verdict(model, s):
    """"yes", "no: reason" or "not checkable: reason"."""
    if s["id"] not in STATEMENTS or s.get("proof") is None:
        return f"not checkable: {s.get('why') or 'no proof of this kind is known here'}"
    try:
        STATEMENTS[s["id"]](model, s)
    except NotCheckable as reason:
        return f"not checkable: {reason}"
    except (AssertionError, Undefined) as reason:
        return f"no: {reason}"
    except (KeyError, IndexError, TypeError, ValueError, ArithmeticError, AttributeError, RecursionError) as error:
        return f"no: the certificate is not well formed ({error!r})"
    return "yes"

def main(path):
    with open(path, encoding="utf-8") as file:
        model, expected, statements = (lambda c: (c["model"], c["hash"], c["statements"]))(json.load(file))
    wrong = None if digest(model) == expected else "no: the data do not have this hash"
    answers = [wrong or verdict(model, s) for s in statements]
    for s, answer in zip(statements, answers, strict=True):
        print(f"{s['id']:<12} {answer}")
    kinds = [answer.partition(":")[0] for answer in answers]
    print(", ".join(f"{kinds.count(kind)} {kind}" for kind in ("yes", "no", "not checkable")))
    return int("no" in kinds)

if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]) if len(sys.argv) == 2 else "usage: python verify.py certificate.json")
