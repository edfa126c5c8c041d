"""Verify a certificate of ``nsmodel check --certificate``: python verify.py certificate.json

This file needs nothing but Python. Each statement is proved anew from the model's data, in fractions; the certificate's hints
(matrices, vectors, covers of boxes) serve where they can be checked. The answer is "yes", "no", or "not checkable: reason".
A graph is a straight-line program: steps ["in", k], ["const", c], ["add", i, j], ["mul", i, j], ["pow", i, exponent],
["fmax", i, j], and ["exp", i], the same with log, sin, cos, tanh, atan, where i and j are numbers of earlier steps.
"""

import collections, decimal, hashlib, json, math, sys
from fractions import Fraction as Q
from itertools import pairwise, product
BITS, CONTEXT = 80, decimal.Context(prec=60)  # Intervals are rounded outwards to so many bits.
HALF, BIG, INF, PI = Q("1/2"), Q(2) ** 1000, math.inf, Q("3.14159265358979323846264338327950288")  # pi to 1e-35
class NotCheckable(Exception): """What this file does not know how to verify."""
class Undefined(Exception): """An operation may be undefined, or jump, on an interval."""
def need(true, text, error=AssertionError):
    if not true: raise error(text)
def numbers(item):
    """Fractions of text, in lists and dictionaries; infinities stay floats."""
    if isinstance(item, (dict, list)):
        return {k: numbers(part) for k, part in item.items()} if isinstance(item, dict) else [numbers(part) for part in item]
    return float(item) if item in ("inf", "-inf") else item if item is None else Q(item)
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
        if S[k][k] <= 0: return not definite and all(S[i][j] == 0 for i in left for j in left)
        left.remove(k)
        for i in left:
            factor = S[i][k] / S[k][k]
            S[i] = [x - factor * y for x, y in zip(S[i], S[k], strict=True)] if factor else S[i]
    return True
# -- intervals
def rounded(x, up=False):
    """x rounded down or up to BITS bits; beyond BIG to infinity."""
    if abs(x) > BIG:
        return (INF if up else BIG) if x > 0 else -rounded(-x, not up)
    x = Q(x)
    n, d, shift = x.numerator, x.denominator, BITS - x.numerator.bit_length() + x.denominator.bit_length()
    if not n or (d & (d - 1) == 0 and n.bit_length() <= BITS):
        return x
    over, under = (n << shift, d) if shift > 0 else (n, d << -shift)
    whole = -(-over // under) if up else over // under
    return Q(whole, 1 << shift) if shift > 0 else Q(whole << -shift)
class VerifierInterval:
    """lo <= x <= hi, fractions or infinite; operations round outwards. Functions raise Undefined where they may have no value."""
    def __init__(self, lo, hi=None, slack=0):
        self.lo, self.hi = rounded(lo - slack), rounded((lo if hi is None else hi) + slack, True)
    def __add__(self, other): return VerifierInterval(self.lo + other.lo, self.hi + other.hi)
    def __neg__(self): return VerifierInterval(-self.hi, -self.lo)
    def __mul__(self, other):
        ends = [a * b if a and b else Q(0) for a in (self.lo, self.hi) for b in (other.lo, other.hi)]
        return VerifierInterval(min(ends), max(ends))
    def scaled(self, c): return self * VerifierInterval(c)
    def within(self, bound): return -bound <= self.lo and self.hi <= bound
    def clipped(self, bound): return VerifierInterval(max(self.lo, -bound), min(self.hi, bound))
    def middle(self):
        """Where a cover cuts: where an end is infinite at 0, or twice as far out."""
        if self.hi < INF:
            return (self.lo + self.hi) / 2 if self.lo > -INF else min(2 * self.hi, Q(-1))
        return max(2 * self.lo, Q(1)) if self.lo > -INF else Q(0)
    def power(self, n):
        if n.denominator == 2:
            return VerifierInterval(root(self.lo).lo, root(self.hi).hi).power(2 * n)
        if n.denominator > 2:
            return (self.log().scaled(n)).exp()
        need(n >= 0 or not self.lo <= 0 <= self.hi, "a division by an interval around 0", Undefined)
        if n < 0: return VerifierInterval(1 / self.hi, 1 / self.lo).power(-n)
        ends = sorted((self.lo**n, self.hi**n))
        return VerifierInterval(0 if n and n % 2 == 0 and self.lo < 0 < self.hi else ends[0], ends[1])
    def exp(self): return VerifierInterval(exp(self.lo).lo, exp(self.hi).hi)
    def log(self): return VerifierInterval(log(self.lo).lo, log(self.hi).hi)
    def atan(self): return VerifierInterval(atan(self.lo).lo, atan(self.hi).hi)
    def tanh(self): return VerifierInterval(1) + (self.scaled(2).exp() + VerifierInterval(1)).power(Q(-1)).scaled(-2)
    def sin(self, quarters=0):
        """sin(x + quarters pi/2): the value in the middle, and the slope 1."""
        if self.lo == self.hi == 0 or self.hi - self.lo > 7:
            return VerifierInterval(quarters) if self.lo == self.hi else VerifierInterval(-1, 1)
        middle, half = (self.lo + self.hi) / 2 + quarters * PI / 2, (self.hi - self.lo) / 2
        k = round(middle / PI)
        y, total = rounded(middle - k * PI), Q(0)
        term = -y if k % 2 else y
        for i in range(1, 36, 2):
            total, term = total + term, rounded(-term * y * y / ((i + 1) * (i + 2)))
        return VerifierInterval(total, slack=half + Q(abs(k) + 2, 2**70)).clipped(Q(1))
def root(x):
    need(x >= 0, "a root of what may be negative", Undefined)
    if x == INF: return VerifierInterval(BIG, INF)
    shift = max(0, BITS - (x.numerator.bit_length() - x.denominator.bit_length()) // 2)
    low = Q(math.isqrt((x.numerator << 2 * shift) // x.denominator), 1 << shift)
    return VerifierInterval(low, low if low * low == x else low + Q(1, 1 << shift))
def digits(x): return CONTEXT.divide(decimal.Decimal(x.numerator), decimal.Decimal(x.denominator))
def exp(x):  # Python rounds exp and ln of decimals correctly; exp(700) > BIG
    if abs(x) > 700:
        return VerifierInterval(BIG, INF) if x > 0 else VerifierInterval(0, 1 / BIG)
    value = Q(CONTEXT.exp(digits(x)))
    return VerifierInterval(value, slack=value / 2**150 if x else 0)
def log(x):
    need(x >= 0, "a logarithm of what may be negative", Undefined)
    return VerifierInterval(-INF, INF) if x in (0, INF) else VerifierInterval(
        Q(CONTEXT.ln(digits(x))), slack=Q(int(x != 1), 2**150))
def atan(x):
    """y + atan(e) where tan(y) is about x and e = (x cos y - sin y)/(cos y + x sin y)."""
    x, y = max(-BIG, min(x, BIG)), VerifierInterval(Q(math.atan(x)))
    e = (VerifierInterval(x) * y.sin(1) + -y.sin()) * (y.sin(1) + VerifierInterval(x) * y.sin()).power(Q(-1))
    need(e.within(Q(1, 2**40)), "an arctangent that the machine gets wrong")
    return y + VerifierInterval(e.lo, e.hi, slack=Q(int(x != 0), 2**110))
FUNCTIONS = {  # f(x), f'(x), f''(x)
    "exp": lambda x: (x.exp(), x.exp(), x.exp()), "log": lambda x: (x.log(), x.power(Q(-1)), -x.power(Q(-2))),
    "sin": lambda x: (x.sin(), x.sin(1), -x.sin()), "cos": lambda x: (x.sin(1), -x.sin(), -x.sin(1)),
    "tanh": lambda x: (t := x.tanh(), d := VerifierInterval(1) + -t.power(Q(2)), (t * d).scaled(-2)),
    "atan": lambda x: (x.atan(), d := (VerifierInterval(1) + x.power(Q(2))).power(Q(-1)), ((x * d).clipped(HALF) * d).scaled(-2))}
def length(row): return sum((x.power(Q(2)) for x in row), VerifierInterval(0)).power(HALF)
# -- graphs
def run(graph, inputs, const, apply):
    """The outputs in an algebra with + and *; ``apply(op, u, w)`` does the other operations, w the second argument."""
    nodes = []
    need("steps" in graph, f"a function that is not written down ({graph.get('why')})", NotCheckable)
    for op, i, *j in graph["steps"]:
        w = nodes[j[0]] if op in ("add", "mul", "fmax") else Q(j[0]) if j else None
        nodes.append(inputs[i] if op == "in" else const(Q(i)) if op == "const" else nodes[i] + w if op == "add"
                     else nodes[i] * w if op == "mul" else apply(op, nodes[i], w))
    return [nodes[k] for k in graph["outputs"]]
class VerifierJet:
    """Value, gradient and Hessian on a box, in intervals; gradient and Hessian may be left out."""
    def __init__(self, v, g, H):
        self.v, self.g, self.H = v, g, H
    def __add__(self, o):
        return VerifierJet(self.v + o.v, [a + b for a, b in zip(self.g, o.g, strict=True)],
                   [[a + b for a, b in zip(r, s, strict=True)] for r, s in zip(self.H, o.H, strict=True)])
    def __mul__(self, o):
        n, g = range(len(self.H)), [self.v * b + o.v * a for a, b in zip(self.g, o.g, strict=True)]
        return VerifierJet(self.v * o.v, g, [[self.v * o.H[i][j] + o.v * self.H[i][j] + self.g[i] * o.g[j] + self.g[j] * o.g[i]
                                      for j in n] for i in n])
    def chain(self, f, d, dd):
        n = range(len(self.H))
        return VerifierJet(f, [d * a for a in self.g], [[dd * self.g[i] * self.g[j] + d * self.H[i][j] for j in n] for i in n])
    def larger(self, o):
        """fmax; where it is not settled the hull of both, without second derivatives."""
        if self.v.lo >= o.v.hi or o.v.lo >= self.v.hi:
            return self if self.v.lo >= o.v.hi else o
        need(not self.H, "a kink", Undefined)
        g = [VerifierInterval(min(a.lo, b.lo), max(a.hi, b.hi)) for a, b in zip(self.g, o.g, strict=True)]
        return VerifierJet(VerifierInterval(max(self.v.lo, o.v.lo), max(self.v.hi, o.v.hi)), g, [])
def jets(graph, box, order=2, wrt=None):
    """The Jet of each output; derivatives up to ``order`` by the inputs ``wrt`` (None: all)."""
    own = list(range(len(graph["inputs"])) if wrt is None else wrt)
    zero = [VerifierInterval(0)] * len(own) if order else []
    flat = [zero] * len(own) if order > 1 else []
    def apply(op, u, w):
        if op in FUNCTIONS:
            return u.chain(*FUNCTIONS[op](u.v))
        if op == "pow":
            first = u.v.power(w - 1).scaled(w) if order else None
            return u.chain(u.v.power(w), first, u.v.power(w - 2).scaled(w * (w - 1)) if order > 1 else None)
        return u.larger(w) if op == "fmax" else need(False, f"no operation {op}")
    inputs = [VerifierJet(x, [VerifierInterval(int(k == i)) for i in own] if order else [], flat) for k, x in enumerate(box)]
    return run(graph, inputs, lambda c: VerifierJet(VerifierInterval(c), zero, flat), apply)
def cover(tree, box, leaf):
    """Whether ``leaf`` holds on each part: a tree [coordinate, left, right] halves the box; anything else is a hint."""
    if isinstance(tree, list) and len(tree) == 3 and isinstance(tree[0], int):
        k, middle = tree[0], box[tree[0]].middle()
        sides = VerifierInterval(box[k].lo, middle), VerifierInterval(middle, box[k].hi)
        return all(cover(part, [*box[:k], side, *box[k + 1 :]], leaf) for part, side in zip(tree[1:], sides, strict=True))
    return bool(leaf(box, tree))
def interval_psd(H):
    """A symmetric interval matrix is psd where its middle is, with the lower ends on the diagonal, less each row's radii."""
    n = range(len(H))
    radii = [sum((H[i][j].hi - H[i][j].lo for j in n if j != i), Q(0)) / 2 for i in n]
    return all(max(-H[i][i].lo, radii[i]) < INF for i in n) and psd(
        [[H[i][i].lo - radii[i] if i == j else H[i][j].middle() for j in n] for i in n])
def norm_below(J, K):
    """|J| <= K for an interval matrix: [K, J; J', K] is psd."""
    if K == INF: return True
    m, n, k, zero = len(J), len(J[0]), VerifierInterval(K), VerifierInterval(0)
    rows = [[k if i == j else zero for j in range(m)] + J[i] for i in range(m)]
    return interval_psd(rows + [[J[i][j] for i in range(m)] + [k if j == l else zero for l in range(n)] for j in range(n)])
# -- polynomials in the inputs 0, 1, ... and in atoms, {monomial: coefficient}
class Poly(dict):
    """A monomial is a tuple of (variable, power)."""
    def __add__(self, o): return Poly({m: a for m in {**self, **o} if (a := self.get(m, Q(0)) + o.get(m, Q(0)))})
    def __neg__(self): return self.scaled(-1)
    def scaled(self, c): return Poly({m: a * c for m, a in self.items() if c})
    def number(self): return self.get((), Q(0)) if set(self) <= {()} else None
    def __mul__(self, o):
        terms = (Poly({tuple(sorted((collections.Counter(dict(m)) + collections.Counter(dict(k))).items())): a * b})
                 for (m, a), (k, b) in product(self.items(), o.items()))
        return sum(terms, Poly())
def constant(c): return Poly({(): Q(c)} if c else {})
def variable(v, c=1): return Poly({((v, 1),): Q(c)} if c else {})
class Atoms:
    """Each operation that is no polynomial is a new variable, the same for the same operation on the same polynomials."""
    def __init__(self):
        self.known, self.meaning, self.nonnegative = {}, {}, set()
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
def slope(p, k, atoms):
    """The derivative of a polynomial by the variable k, which is in none of its atoms."""
    need(k not in atoms.inputs(*(variable(v) for m in p for v, _ in m if v in atoms.meaning)), "a derivative", NotCheckable)
    terms = ((tuple((v, n - (v == k)) for v, n in m if n > (v == k)), a * dict(m)[k]) for m, a in p.items() if k in dict(m))
    return sum((Poly({m: a}) for m, a in terms), Poly())
def hessian(p, own, atoms):
    """The constant second derivatives of p by the variables ``own``; None where p is no quadratic in them."""
    H = [[slope(slope(p, i, atoms), j, atoms).number() for j in own] for i in own]
    return None if any(x is None for row in H for x in row) else H
def squares(hint):
    """m'G m with monomials m and a psd G: a sum of squares."""
    m = [Poly({tuple((int(v), int(n)) for v, n in one): Q(1)}) for one in hint["monomials"]]
    need(psd(G := numbers(hint["G"])) and len(G) == len(m), "G is not psd")
    return sum(((a * b).scaled(G[i][j]) for (i, a), (j, b) in product(enumerate(m), enumerate(m))), Poly())
def affine(p, own, atoms):
    """(row, rest): p = row . own + rest, the rest free of these inputs; None where it is not so."""
    rest = Poly({m: a for m, a in p.items() if len(m) != 1 or m[0][1] != 1 or m[0][0] not in own})
    return None if atoms.inputs(rest) & set(own) else ([p.get(((v, 1),), Q(0)) for v in own], rest)
def convex(p, own, atoms, hint=None):
    """Whether p is convex: a psd quadratic, even powers and convex atoms weighted >= 0, or what is left a convex polynomial."""
    # With a hint that has any degree, and y'D2p y, y_k the variable -1 - k, is a sum of squares.
    rest = Poly()
    for m, a in p.items():
        inner = [(v, n) for v, n in m if atoms.inputs(variable(v)) & set(own)]
        if inner and all(v in own for v, _ in m) and (hint or sum(n for _, n in m) <= 2):
            rest[m] = a
        elif inner and not (len(m) == 1 and a > 0 and bends(*inner[0], own, atoms)):
            return False
    if hint:
        form = (slope(slope(rest, i, atoms), j, atoms) * variable(-1 - i) * variable(-1 - j) for i in own for j in own)
        return not sum(form, -squares(hint))
    H = hessian(rest, own, atoms)
    return H is not None and psd(H)
def bends(v, n, own, atoms):
    """Whether v^n is convex: an even power, the norm of an affine map, a larger or an exp of convex ones, and their powers."""
    if v in own:
        return n % 2 == 0 or v in atoms.nonnegative
    op, u, *more = atoms.meaning[v]
    if n > 1 and not positive(variable(v), atoms): return False
    if op == "pow" and more[0] == HALF:  # z^2 u(x/z) is a psd quadratic form, z the variable -1
        form = Poly({(*[(-1, k)] * (k > 0), *m): a for m, a in u.items() for k in [2 - sum(n for _, n in m)]})
        H = hessian(form, sorted({w for m in form for w, _ in m}), atoms)
        return H and psd(H) and not any(w in atoms.meaning and atoms.inputs(variable(w)) & set(own) for m in u for w, _ in m)
    powers = op == "pow" and more[0] > 1 and positive(u, atoms)
    return (powers or op in ("fmax", "exp")) and all(convex(part, own, atoms) for part in (u, *more) if isinstance(part, Poly))
def positive(p, atoms):
    """Whether all terms are >= 0: even powers, and inputs and atoms that are."""
    def is_nonnegative(v):
        op, u, *more = atoms.meaning.get(v, ("in", None))
        return (v in atoms.nonnegative or op == "exp" or (op == "pow" and more[0].denominator > 1)
                or (op == "fmax" and (u == -more[0] or positive(u, atoms) or positive(more[0], atoms))))
    return all(a >= 0 and all(n % 2 == 0 or is_nonnegative(v) for v, n in m) for m, a in p.items())
# -- statements: each proves one hypothesis of the model m; s has the numbers, the scope and the hints
def box_of(names, s, *graphs):
    """The scope's intervals of some inputs, all numbers where it has none; 0 where no step of the graphs looks at one."""
    used = {step[1] for graph in graphs for step in graph.get("steps", ()) if step[0] == "in"} if graphs else range(len(names))
    own = {**((s["scope"] or {}).get("states") or {}), "t": (s["scope"] or {}).get("time")}
    return [VerifierInterval(*(numbers(own.get(name)) or (-INF, INF))) if k in used else VerifierInterval(0)
            for k, name in enumerate(names)]
def on_cover(graph, s, tree, order, leaf, wrt=None):
    """``leaf(jets)`` on each part of the scope's box."""
    need(cover(tree, box_of(graph["inputs"], s, graph), lambda part, _: leaf(jets(graph, part, order, wrt))), "a bound fails")
class Shape:
    """A constraint g(t, q_1, ..., q_k) of the form "affine" or "norm", w |A q + c(t)| + offset(t)."""
    # With "box" [low, high]: w |q - min(max(q, low), high)| + offset(t), the distance to a box.
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
            return need(leaf(VerifierInterval(0), VerifierInterval(0), VerifierInterval(self.offset.number() or 0)),
                        "a bound fails")
        def part(box, _):
            rest = [VerifierInterval(0)] * len(self.own)  # of an affine g the offset is its value where q = 0
            found = [jets(g, (box + rest)[: len(g["inputs"])], 1, [0])[0] for g in [*self.hint["c"], self.hint["offset"]]]
            return leaf(length([j.g[0] for j in found[:-1]]), found[-1].g[0], found[-1].v)
        need(cover(self.hint.get("time"), box_of(["t"], self.s), part), "a bound fails at some time")
def shapes(m, s): return [Shape(c, hint, s) for c, hint in zip(m["constraints"], s["proof"]["constraints"], strict=True)]
def s_convex(m, s):
    for c in shapes(m, s):  # a norm of an affine map, and the distance to a box, are convex
        need(c.form in ("affine", "norm") or curved(c.graph, s, c.hint, c.own, Atoms(), c.own) is None, "no form")
NEEDED = {"A0": (), "A1": ("a", "b"), "A2": ("speed",), "A3": ("turn",), "A4": ("M", "M_contact")}
def regular(m, s):
    """A0 to A4: a <= |grad g| <= b, |d_t g| <= speed, |d_t grad g| <= turn, |D^2 g| <= M if g > -delta, M_contact if g >= 0."""
    # c = delta / b is the distance of the boundary of {g > -delta}; a number that is not given is not looked at.
    need(all(name in s["value"] for name in NEEDED[s["id"]]), "a number is missing")
    most = {**dict.fromkeys(("b", "speed", "turn", "M", "M_contact"), INF), "a": Q(0), "c": Q(0), **numbers(s["value"])}
    a, b, speed, turn, M, near, far = (most[name] for name in ("a", "b", "speed", "turn", "M", "M_contact", "c"))
    need(min(turn, M, near) >= 0 and (a > 0 or "a" not in s["value"]), "a number has the wrong sign")
    for c in shapes(m, s):
        if c.form == "affine":
            need(a * a <= dot(c.row, c.row) <= b * b, "a or b")
            c.in_time(lambda _, rate, offset: rate.within(speed))
            continue
        delta, steep = c.delta, numbers(c.hint["b"])
        need(0 < delta and steep <= b and (not far or far * steep <= delta), "delta, b or c")
        if c.form == "norm":  # grad g = w A'n, |n| = 1; D^2 g = w^2 A'(1 - nn')A / (g - offset)
            reach, AA = Q(c.hint["reach"]), times(c.A, transpose(c.A))
            need(delta < reach and psd(plus(AA, eye(len(AA), (a / c.w) ** 2), -1)), "a")
            need(psd(plus(eye(len(AA), (steep / c.w) ** 2), AA, -1)), "b")
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
        close = [(c["graph"]["inputs"][1:], g.g[1:]) for c, g in found if g.v.lo <= rho]
        if len(close) <= 1 or any(g.v.hi < 0 for _, g in found):
            return True
        d = dict(zip(names[1:], numbers(d), strict=True))
        along = [sum((x.scaled(d[v]) for v, x in zip(own, slope, strict=True)), VerifierInterval(0)) for own, slope in close]
        size = length([VerifierInterval(x) for x in d.values()])
        return all(x.lo * gamma >= (length(slope) * size).hi for x, (_, slope) in zip(along, close, strict=True))
    graphs = [c["graph"] for c in m["constraints"]]
    used = {"steps": [["in", names.index(g["inputs"][k])] for g in graphs for op, k, *_ in g.get("steps", ()) if op == "in"]}
    need(len(graphs) <= 1 or cover(s["proof"]["cover"], box_of(names, s, used), leaf), "gamma fails on a part")
def velocity(m, s):
    f, atoms, own, value = m["f"], Atoms(), list(range(1, len(m["f"]["inputs"]))), numbers(s["value"])
    found, K, L = [affine(p, own, atoms) for p in atoms.read(f)], value["K_f"], value["L_f"]
    def small(j, far=Q(0)):
        rate = length([x.g[0] for x in j]).hi
        return length([x.v for x in j]).hi <= L * (1 + far) and rate <= value.get("L_t", rate)
    if all(found):
        need(norm_below([[VerifierInterval(x) for x in row] for row, _ in found], K) and L >= K, "K_f")
        time = box_of(["t"], s) if atoms.inputs(*(rest for _, rest in found)) else [VerifierInterval(0)]
        part = lambda box, _: small(jets(f, box + [VerifierInterval(0)] * len(own), 1, [0]))  # noqa: E731
        return need(cover(s["proof"].get("time"), time, part), "L_f or L_t")
    part = lambda box, _: small(j := jets(f, box, 1), length(box[1:]).lo) and norm_below([x.g[1:] for x in j], K)  # noqa: E731
    need(cover(s["proof"]["cover"], box_of(f["inputs"], s, f), part), "K_f, L_f or L_t")
def start(m, s):
    q0 = dict(zip(m["f"]["inputs"][1:], numbers(m["q0"]), strict=True))
    for c in m["constraints"]:
        (g,) = jets(c["graph"], [VerifierInterval(0), *(VerifierInterval(q0[name]) for name in c["graph"]["inputs"][1:])], 0)
        need(g.v.lo >= 0, "g < 0 at the start, or too near to 0")
def law(m):  # (lower, upper) of each multiplier of a Lur'e system
    need(m["law"] and all(block["kind"] == "box" for block in m["law"]), "a law that is no box", NotCheckable)
    return [ends for block in m["law"] for ends in zip(numbers(block["lower"]), numbers(block["upper"]), strict=True)]
def bounded(m): return all(b["kind"] == "ball" or (b["kind"] == "box" and max(map(abs, numbers(b["lower"] + b["upper"]))) < INF)
                           for b in m["law"])
def storage(m, s):
    P, B, C = (numbers(part) for part in (s["proof"]["P"], m["B"], m["C"]))
    need(P == transpose(P) and psd(P, True), "P is not symmetric and positive definite")
    need(times(P, B) == transpose(C), "P B = C' fails")
    return P
def growth(m, s):
    P, atoms, omega = storage(m, s), Atoms(), Q(s["value"]["omega"])
    if "cover" in s["proof"]:
        return on_cover(m["A"], s, s["proof"]["cover"], 1, lambda j: form_below([x.g for x in j], P, omega))
    one_sided(atoms.read(m["A"]), P, omega, atoms)
def everything(m):
    """Whether the range of D + dXi is the whole space: D + D' > 0, K bounded, or a convex potential that is finite."""
    if m["phi"]:
        convex_phi = convex(*(atoms := Atoms()).read(m["phi"]), range(len(m["D"])), atoms)
        return convex_phi and jets(m["phi"], [VerifierInterval(-INF, INF)] * len(m["D"]), 0)
    return psd(numbers(m["D"]), True) or bounded(m)
def convex_ranges(m, s):  # 5.4b; of a potential of one variable the domain of dXi is an interval
    polyhedral = m["law"] and all(block["kind"] in ("box", "polyhedron") for block in m["law"])
    need((everything(m) and (m["law"] or len(m["D"]) == 1)) or (polyhedral and psd(numbers(m["D"]))), "a range", NotCheckable)
def in_range(m, s, x=None):
    """C x + e = D'k + y + (D + D')v, k and y inside: y > 0 where l has no upper end, an end where l is bounded is no limit."""
    if everything(m): return
    C, D, p, column = numbers(m["C"]), numbers(m["D"]), numbers(s["proof"]), lambda v: [[entry] for entry in v]
    right = plus(plus(times(transpose(D), column(p["k"])), column(p["y"])), times(plus(D, transpose(D)), column(p["v"])))
    left = plus(times(C, column(p["x"] if x is None else x)), column(numbers(m.get("e", ["0"] * len(D)))))
    need(psd(D) and left == right, "C x + e = D'k + y + S v fails")
    for (low, high), k, y in zip(law(m), p["k"], p["y"], strict=True):
        free = (low > -math.inf) + 2 * (high < math.inf)
        need(low < k < high and (free == 3 or (free == 1 and y > 0) or (free == 2 and y < 0)), "k or y is not inside")
def at_rest(m, s):
    in_range(m, s, [Q(0)] * len(m["x0"]))
    zero = all(x.v.lo == 0 == x.v.hi for x in jets(m["A"], [VerifierInterval(0)] * len(m["x0"]), 0)) and not any(
        Atoms().read(m["f"]))
    need(zero and "e" not in m and all(a <= 0 <= b for a, b in law(m)), "A(0), f or e is not 0, or 0 is not in K")
def form_below(J, P, L):
    """P J + J'P <= 2 L P for an interval matrix J."""
    n = range(len(P))
    PJ = [[sum((J[k][b].scaled(P[a][k]) for k in n), VerifierInterval(0)) for b in n] for a in n]
    return interval_psd([[VerifierInterval(2 * L * P[a][b]) + -PJ[a][b] + -PJ[b][a] for b in n] for a in n])
def one_sided(V, P, L, atoms):
    """<V(x) - V(y), P (x - y)> <= L <x - y, P (x - y)> of an affine V."""
    rows = [affine(p, list(range(len(P))), atoms) for p in V]
    need(all(row and row[1].number() is not None for row in rows), "a function that is not affine", NotCheckable)
    need(psd(plus([[L * x for x in row] for row in P], times(P, [row for row, _ in rows]), -1)), "the bound")
def pieces(graph, atoms):
    """p and (w, a, c), of a function p + sum w |a'z + c|: fmax(u, v) is (u + v)/2 + |u - v|/2."""
    n, (p,), switches = list(range(len(graph["inputs"]))), atoms.read(graph), []
    for key, a in list(p.items()):
        op, u, *more = atoms.meaning.get(key[0][0] if len(key) == 1 and key[0][1] == 1 else None, (None, None))
        if op == "fmax" and a > 0:
            row, c = affine(u + -more[0], n, atoms) or need(False, "a kink where no affine function is 0", NotCheckable)
            switches.append((a / 2, row, c.number()))
            p = p + Poly({key: -a}) + (u + more[0]).scaled(a / 2)
    return p, switches
def selection(m, atoms):
    """F - S = V - sum w l a, l in Sgn(a'x + c): the polynomials V, and (w, a, c), of S or of the gradient of phi."""
    n, V, switches = list(range(len(m["x0"]))), atoms.read(m["F"]), []
    if m["S"]:
        V = [v + -p for v, p in zip(V, atoms.read(m["S"]), strict=True)]
    for weights, graph in m["switches"]:
        weights, (row, c) = numbers(weights), affine(*atoms.read(graph), n, atoms) or need(False, "a switch", NotCheckable)
        w = dot(weights, row) / dot(row, row)
        need(w >= 0 and weights == [w * x for x in row], "a switch that is no subdifferential", NotCheckable)
        switches.append((w, row, c.number()))
    if m["phi"]:
        p, switches = pieces(m["phi"], atoms)
        V = [v + -slope(p, i, atoms) for i, v in zip(n, V, strict=True)]
    return V, switches
def curved(graph, s, hint, own, atoms, wrt=None):
    """A function is convex: its Hessian is psd on a cover, or by the rules and squares."""
    if "cover" in hint:
        return on_cover(graph, s, hint["cover"], 2, lambda found: interval_psd(found[0].H), wrt)
    need(convex(*atoms.read(graph), own, atoms, hint.get("squares")), "not convex by the rules")
def monotone(m, s):
    atoms, n = Atoms(), range(len(m["x0"]))
    if m["phi"]:
        return curved(m["phi"], s, s["proof"], n, atoms)
    selection({**m, "S": None}, atoms)  # the switches are subdifferentials
    if "cover" in s["proof"]:
        return on_cover(m["S"], s, s["proof"]["cover"], 1, lambda j: form_below([[-x for x in y.g] for y in j], eye(len(n)), 0))
    one_sided([-p for p in atoms.read(m["S"])] if m["S"] else [Poly()] * len(n), eye(len(n)), 0, atoms)
def set_with_interior(m, s, origin=False):
    """C is convex, and a point is inside; or 0 is in C."""
    atoms, n = Atoms(), list(range(len(m["C"]["inputs"])))
    need(all(convex(-p, n, atoms) for p in atoms.read(m["C"])), "a row is not concave by the rules")
    point = [VerifierInterval(x) for x in ([0] * len(n) if origin else numbers(s["proof"]["interior"]))]
    need(all(g.v.lo > 0 or (origin and g.v.lo == 0) for g in jets(m["C"], point, 0)), "the point is not inside")
def smooth(m, s, names="F", order=0):
    """Operations that are continuous (or twice differentiable) everywhere, else values (or Hessians) on a cover."""
    for graph in (m[name] for name in names):
        if not all(op in ("in", "const", "add", "mul", "exp", "sin", "cos", "tanh", "atan") or (op == "fmax" and not order)
                   or (op == "pow" and Q(rest[1]) >= 0 and Q(rest[1]).denominator == 1) for op, *rest in graph.get("steps", "?")):
            on_cover(graph, s, s["proof"].get("cover"), order, lambda found: True)
def linear_growth(m, s):
    """F - S is A x + b less switches: |A| <= a_2, |b - sum w l a| <= a_1."""
    V, switches = selection(m, atoms := Atoms())
    rows = [affine(p, list(range(len(V))), atoms) for p in V]
    need(all(row and row[1].number() is not None for row in rows) and len(switches) <= 12, "F or S is not affine", NotCheckable)
    need(norm_below([[VerifierInterval(x) for x in row] for row, _ in rows], Q(s["value"]["a_2"])), "a_2")
    for signs in product((-1, 1), repeat=len(switches)):
        lw = [(e * w, a) for e, (w, a, _) in zip(signs, switches, strict=True)]
        v = [b.number() + sum(w * a[i] for w, a in lw) for i, (_, b) in enumerate(rows)]
        need(dot(v, v) <= Q(s["value"]["a_1"]) ** 2, "a_1")
def on_differences(m, s):
    """M-24: of an affine F - S, or by its Jacobians on the parts that C may meet; sgn is monotone."""
    L, unit, atoms = Q(s["value"]["L"]), eye(len(m["x0"])), Atoms()
    if "cover" not in s["proof"]:
        return one_sided(selection(m, atoms)[0], unit, L, atoms)
    selection({**m, "S": None, "phi": None}, atoms)  # the switches are subdifferentials
    def part(box, _):
        J = [j.g for j in jets(m["F"], box, 1)]
        minus = [j.g for j in jets(m["S"], box, 1)] if m["S"] else jets(m["phi"], box)[0].H if m["phi"] else []
        J = [[a + -b for a, b in zip(u, w, strict=True)] for u, w in zip(J, minus, strict=True)] if minus else J
        return (m["C"]["outputs"] and any(g.v.hi < 0 for g in jets(m["C"], box, 0))) or form_below(J, unit, L)
    need(cover(s["proof"]["cover"], box_of(m["F"]["inputs"], s), part), "L")
def dissipation(m, s, atoms):
    """beta - alpha |x|^2 - <x, F - S>, as -l a'x <= |c|."""
    (V, switches), alpha = selection(m, atoms), Q(s["value"]["alpha"])
    p = constant(Q(s["value"]["beta"]) - sum(w * abs(c) for w, _, c in switches))
    return sum((-(variable(i) * (v + variable(i, alpha))) for i, v in enumerate(V)), p)
def dissipative(m, s):
    """0 in C, and the dissipation >= 0; projections on T_C do no harm."""
    set_with_interior(m, s, origin=True)
    need(positive(dissipation(m, s, atoms := Atoms()) + -squares(s["proof"]), atoms) and Q(s["value"]["alpha"]) > 0, "beta")
def leftover(p, atoms):  # without the terms that are no polynomials and convex by the rules
    return Poly({k: a for k, a in p.items() if a < 0 or len(k) != 1 or k[0][0] == 0 or not bends(*k[0], [0], atoms)})
def friction(m, s):
    """theta'(0) >= 0, theta is C1 and theta'' >= 0 for s >= 0: by its Hessian on a cover, or but for convex terms as squares."""
    for graph, hint in zip(m["theta"], s["proof"]["theta"], strict=True):
        atoms, line = Atoms(), [VerifierInterval(0, INF)]
        (p,), atoms.nonnegative = atoms.read(graph), {0}
        need(all(op != "fmax" for op, *_ in graph["steps"]), "a kink of theta", NotCheckable)
        need(cover(hint["slope"], line, lambda box, _, g=graph: jets(g, box, 1)), "theta is not C1")
        need(jets(graph, [VerifierInterval(0)], 1)[0].g[0].lo >= 0, "theta'(0) < 0")
        if "cover" in hint:
            need(cover(hint["cover"], line, lambda box, _, g=graph: jets(g, box)[0].H[0][0].lo >= 0), "theta'' < 0")
            continue
        first, second = map(squares, hint["squares"])
        need(slope(slope(leftover(p, atoms), 0, atoms), 0, atoms) == first + variable(0) * second, "theta'' is another")
    need(psd(numbers(m["damping"])), "the damping is not psd")
def potential(m, s):
    """g is convex, and g >= bound: by squares, or as g - mu |x|^2/2 is convex and grad g small at a point."""
    atoms, n, bound = Atoms(), list(range(len(m["g"]["inputs"]))), Q(s["value"]["lower bound of g"])
    (p,), hint = atoms.read(m["g"]), s["proof"]
    set_with_interior(m, s)
    curved(m["g"], s, hint, n, atoms)
    if "mu" not in hint:
        return need(positive(p + constant(-bound) + -squares(hint["bound"]), atoms), "inf g")
    mu, (g,) = Q(hint["mu"]), jets(m["g"], [VerifierInterval(x) for x in numbers(hint["least"])], 1)
    need(mu > 0 and convex(sum((variable(i) * variable(i, -mu / 2) for i in n), p), n, atoms), "g - mu |x|^2/2 is not convex")
    need(g.v.lo - length(g.g).hi ** 2 / (2 * mu) >= bound, "inf g")
def dry(m, s):
    total = eye(len(m["g"]["inputs"]), -(Q(s["value"]["radius of A(0)"]) ** 2))
    for graph, H in zip(m["theta"], numbers(m["H"]), strict=True):
        total = plus(total, times(transpose(H), H), max(jets(graph, [VerifierInterval(0)], 1)[0].g[0].lo, Q(0)) ** 2)
    need(psd(total) and Q(s["value"]["radius of A(0)"]) > 0, "the radius")
def step(m, s):
    """1 - s X is regular for 0 <= s <= h, X = M^-1 (theta f_x + gamma g_x), as <v, X v> < |v|^2 / h."""
    n, h, atoms, inverse = len(m["x0"]), Q(s["value"]["h"]), Atoms(), numbers(s["proof"]["inverse"])
    rows = [[affine(p, list(range(1, n + 1)), atoms) for p in atoms.read(m[name])] for name in "fg"]
    need(times(numbers(m["M"]), inverse) == eye(n) and h >= max(numbers(m["steps"])), "M^-1 is another, or h not the step")
    theta, gamma = Q(m["theta"]), Q(m["gamma"])
    def part(box, _):
        F, G = ([[VerifierInterval(x) for x in row] for row, _ in found] if all(found) else
                [j.g for j in jets(m[name], box, 1, range(1, n + 1))] for name, found in zip("fg", rows, strict=True))
        X = [[sum((F[l][k].scaled(theta * row[l]) + G[l][k].scaled(gamma * row[l]) for l in range(n)), VerifierInterval(0))
              for k in range(n)] for row in inverse]
        return form_below(X, eye(n), (1 - Q(1, 2**30)) / h)
    need(cover(s["proof"]["cover"], box_of(m["f"]["inputs"], s, m["f"], m["g"]), part), "the bound fails on a part")
def complementarity(m, s):
    """W_mlcp = h gamma C W^-1 B + D is psd at each step; F-unique: definite, or K is bounded and B = T (W_mlcp + W_mlcp')."""
    n, atoms, theta, gamma = len(m["x0"]), Atoms(), Q(m["theta"]), Q(m["gamma"])
    f, g, y = ([affine(p, range(1, len(m["f"]["inputs"])), atoms) for p in atoms.read(m[name])] for name in "fgh")
    need(all(f + g + y), "f, g or h is not affine", NotCheckable)
    (A, _), (K, B), (C, D) = (([row[:n] for row, _ in part], [row[n:] for row, _ in part]) for part in (f, g, y))
    for h, inverse, T in zip(numbers(m["steps"]), *(numbers(s["proof"][name]) for name in ("inverses", "T")), strict=True):
        need(times(plus(plus(numbers(m["M"]), A, -h * theta), K, -h * gamma), inverse) == eye(n), "W has another inverse")
        W = plus(D, times(times(C, inverse), B), h * gamma)
        need(psd(W), "W_mlcp is not psd", NotCheckable)
        if s["id"] == "F-unique" and not psd(W, True):
            need(bounded(m) and T and times(T, plus(W, transpose(W))) == B, "W_mlcp lets x vary", NotCheckable)
STATEMENTS = {
    "S-convex": s_convex, **dict.fromkeys(NEEDED, regular), "A5": qualified, "A5'": qualified, "S-f": velocity, "S-start": start,
    "3.1": lambda m, s: need(all(a < b for a, b in law(m)), "K has no interior"), "5.1": storage, "5.2": growth,
    "4.1": lambda m, s: need((x := Q(s["value"]["least"])) >= 0 and psd(plus(numbers(m["D"]), eye(len(m["D"]), -x))), "D"),
    "5.4a": in_range, "5.4b": convex_ranges, "5.4c": in_range, "5.x0": lambda m, s: in_range(m, s, numbers(m["x0"])),
    "7.1": at_rest, "M-T": monotone, "M-C": set_with_interior, "M-A1": smooth, "M-A2": linear_growth, "M-A3": dissipative,
    "M-24": on_differences, "O-theta": friction, "O-g": potential, "O-dry": dry,
    "O-steps": lambda m, s: need(all(0 < x <= y for x, y in pairwise(numbers([m["steps"][0], *m["steps"]]))), "a step shrinks"),
    "F-jacobians": lambda m, s: smooth(m, s, "fgh", 2), "F-step": step, "F-W": step, "F-mlcp": complementarity,
    "F-unique": complementarity}
def digest(model): return hashlib.sha256(json.dumps(model, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
def verdict(model, s):
    """"yes", "no: reason" or "not checkable: reason"."""
    if s["id"] not in STATEMENTS or s.get("proof") is None:
        return f"not checkable: {s.get('why') or 'no proof of this kind is known here'}"
    try:
        STATEMENTS[s["id"]](model, s)
    except NotCheckable as reason:
        return f"not checkable: {reason}"
    except Exception as reason:  # whatever is wrong with a certificate
        return f"no: {reason or 'it is not well formed'}"
    return "yes"
def main(path):
    try:
        with open(path, encoding="utf-8") as file: certificate = json.load(file)
        model, statements, ids = certificate["model"], certificate["statements"], [s["id"] for s in certificate["statements"]]
        same = digest(model) == certificate["hash"]
    except (OSError, ValueError, LookupError, TypeError) as reason:
        return f"{path} is no certificate: {type(reason).__name__}: {reason}"
    answers = [verdict(model, s) if same else "no: the data do not have this hash" for s in statements]
    print("\n".join(f"{id:<12} {answer}" for id, answer in zip(ids, answers, strict=True)))
    kinds = [answer.partition(":")[0] for answer in answers]
    print(", ".join(f"{kinds.count(kind)} {kind}" for kind in ("yes", "no", "not checkable")))
    return int("no" in kinds)
if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]) if len(sys.argv) == 2 else "usage: python verify.py certificate.json")
