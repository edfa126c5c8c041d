"""A model as mathematics (SymPy, LaTeX) and a report as a table, a page and data, held against CasADi and each other."""

from __future__ import annotations

import json
import re
import time

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from fuzz_models import share

from nsmodel import LureSystem, ModelError, SweepingProcess, ball, box, complementarity, equality, polyhedron, product, relay
from nsmodel import second_order_cone as cone
from nsmodel.files.storage import dumps, loads
from nsmodel.hypotheses.equations import law_latex, model_equations, to_sympy
from nsmodel.hypotheses.findings import HOLDS, SAMPLED, UNKNOWN, VERDICTS, VIOLATED, Hypothesis, make_consequence, make_finding
from nsmodel.hypotheses.latex import SymbolNames, formulas, number_latex, symbol_latex
from nsmodel.hypotheses.report import Report, markdown, report_data, report_text, witness_value_text

X = ca.SX.sym("x", 3)
PLAIN = SymbolNames({}, {})
UNARY = (
    ca.sin, ca.cos, ca.tan, ca.atan, ca.exp, ca.tanh, ca.sinh, ca.cosh, ca.asinh, ca.erf, ca.fabs, ca.sign, ca.floor, ca.ceil,
    ca.expm1, lambda a: -a, lambda a: a**2, lambda a: a**3, lambda a: ca.sqrt(1 + a**2), lambda a: ca.log(1 + a**2),
    lambda a: ca.log1p(a**2), lambda a: 1 / (1 + a**2), lambda a: (1 + a**2) ** 0.7, lambda a: 2 * a,
    lambda a: ca.acos(ca.tanh(a)), lambda a: ca.asin(ca.tanh(a)), lambda a: ca.atanh(ca.tanh(a) / 2),
    lambda a: ca.acosh(1 + a**2), ca.logic_not,
)  # fmt: skip
BINARY = (
    lambda a, b: a + b, lambda a, b: a - b, lambda a, b: a * b, lambda a, b: a / (1 + b**2), ca.fmin, ca.fmax, ca.atan2,
    lambda a, b: ca.fmod(a, 1 + b**2), ca.hypot, ca.copysign, lambda a, b: ca.norm_2(ca.vertcat(a, b)),
    lambda a, b: a < b, lambda a, b: a <= b, lambda a, b: a == b, lambda a, b: a != b, ca.logic_and, ca.logic_or,
    lambda a, b: (1 + a**2) ** b,
)  # fmt: skip


def random_expression(rng, depth):
    if depth == 0:
        return X[int(rng.integers(3))] if rng.random() < 0.7 else ca.SX(float(rng.choice([0.1, -2.5, 3, 1 / 3, np.pi, 2**0.5])))
    a, b, c = (random_expression(rng, depth - 1) for _ in range(3))
    kind = rng.random()
    if kind < 0.4:
        return UNARY[rng.integers(len(UNARY))](a)
    return BINARY[rng.integers(len(BINARY))](a, b) if kind < 0.85 else ca.if_else(a < b, c, a)


def small(expr, at):
    """Whether all that ``expr`` holds is of ordinary size: beside 1e16, sin and floor are only round-off."""
    parts, pile = [], [expr]
    while pile:
        parts.append(pile.pop())
        pile += [parts[-1].dep(i) for i in range(parts[-1].n_dep())]
    values = np.array(ca.Function("parts", [X], [ca.vertcat(*parts)])(at))
    return bool(np.isfinite(values).all() and np.abs(values).max() < 1e3)


def test_sympy_has_the_values_of_casadi_for_random_expressions():
    rng, compared = np.random.default_rng(5), 0
    while compared < share(300, 60):
        expr, points = random_expression(rng, int(rng.integers(1, 4))), rng.uniform(-1.5, 1.5, (3, 3))
        if not all(small(expr, point) for point in points):
            continue
        value = sp.lambdify(list(sp.symbols("x_0:3", real=True)), to_sympy(expr)[0], "math")
        exact = ca.Function("exact", [X], [expr])
        for point in points:
            assert float(value(*point)) == pytest.approx(float(exact(point)), rel=1e-9, abs=1e-9), expr
        compared += 1


def test_sympy_numbers_are_those_the_user_wrote():
    k = ca.SX.sym("k")
    S = sp.Symbol("k", real=True)
    M = to_sympy(ca.vertcat(ca.horzcat(0.1 * k, 1e-6, np.sqrt(2)), ca.horzcat(2 / 3 * k, -np.pi / 4, 1e300)))
    assert M == sp.Matrix([[S / 10, sp.Rational(1, 10**6), sp.sqrt(2)], [2 * S / 3, -sp.pi / 4, sp.Integer(10) ** 300]])
    assert to_sympy(ca.SX([1.2345678901234567]))[0] == sp.Rational("1.2345678901234567")  # no simple fraction is near
    assert to_sympy(ca.vertcat(ca.SX(float("inf")), -ca.SX(float("inf")))) == sp.Matrix([sp.oo, -sp.oo])
    assert to_sympy(ca.SX(2, 3)) == sp.zeros(2, 3)


def test_sympy_puts_the_halves_of_a_condition_together():
    x, y = sp.symbols("x_0 x_1", real=True)
    assert to_sympy(ca.if_else(X[0] < 4, X[1], 1))[0] == sp.Piecewise((y, x < 4), (1, True))
    both = ca.logic_and(X[0] <= 4, X[1] > 0)
    assert to_sympy(ca.if_else(both, X[1], ca.inf))[0] == sp.Piecewise((y, sp.And(x <= 4, y > 0)), (sp.oo, True))


def test_sympy_refuses_what_it_does_not_know():
    with pytest.raises(ModelError, match="no counterpart in SymPy"):
        to_sympy(ca.remainder(X[0], 2))


@pytest.mark.parametrize(
    ("expr", "latex"),
    [
        (X[0] - (X[1] - 3), r"x_{0} - \left(x_{1} - 3\right)"),
        (-(X[0] - X[1]), r"-\left(x_{0} - x_{1}\right)"),
        (-4.5 * X[0] * X[1], r"-4.5\,x_{0}\,x_{1}"),
        ((-4.5 * X[0]) ** 2, r"\left(-4.5\,x_{0}\right)^{2}"),
        ((-X[0]) ** X[1], r"\left(-x_{0}\right)^{x_{1}}"),
        ((X[0] * X[1]) ** 2, r"\left(x_{0}\,x_{1}\right)^{2}"),
        (ca.sin(X[0]) ** 2, r"\left(\sin\left(x_{0}\right)\right)^{2}"),
        (X[0] ** 3, r"x_{0}^{3}"),
        (X[0] ** 4, r"x_{0}^{4}"),
        (X[0] ** -1.5, r"x_{0}^{-1.5}"),
        (X[0] / -3, r"-\frac{x_{0}}{3}"),
        ((X[0] - X[1]) / (X[0] + 1), r"\frac{x_{0} - x_{1}}{x_{0} + 1}"),
        (X[0] * (-X[1]), r"-x_{0}\,x_{1}"),
        (2 * (X[0] + 1), r"2\,\left(x_{0} + 1\right)"),
        (ca.fmax(0, ca.fmax(X[0], X[1])), r"\max\left(0,\ x_{0},\ x_{1}\right)"),
        (ca.norm_2(X[:2]), r"\left\Vert \left(x_{0},\ x_{1}\right) \right\Vert"),
        (ca.sqrt(X[0] ** 2 + X[1]), r"\sqrt{x_{0}^{2} + x_{1}}"),
        (ca.if_else(X[0] < 1, X[1], 0), r"\begin{cases} x_{1} & \text{where } x_{0} < 1 \\ 0 & \text{elsewhere} \end{cases}"),
    ],
)
def test_formula_is_bracketed_as_it_is_meant(expr, latex):
    assert formulas(expr, PLAIN) == [latex]


class Reader:
    """Reads a formula of sums, products, fractions and powers back, by the rules of school notation."""

    def __init__(self, latex, x):
        self.tokens = re.findall(r"\\frac|\\left\(|\\right\)|\\,|\\cdot|\d+\.?\d*|x_\{\d\}|[-+^{}]", latex)
        assert "".join(self.tokens) == latex.replace(" ", ""), latex
        self.x = x

    def next(self, *expected):
        return self.tokens.pop(0) if self.tokens and (not expected or self.tokens[0] in expected) else None

    def sum(self):
        total = 0.0 if self.tokens[0] == "-" else self.product()
        while (sign := self.next("+", "-")) is not None:
            total += self.product() if sign == "+" else -self.product()
        return total

    def product(self):
        value = self.power()
        while self.tokens and self.tokens[0] in (r"\,", r"\cdot"):
            self.next()
            value *= self.power()
        return value

    def power(self):
        value = self.atom()
        return value ** self.group() if self.next("^") else value

    def group(self):
        assert self.next("{")
        value = self.sum()
        assert self.next("}")
        return value

    def atom(self):
        token = self.next()
        if token == r"\frac":
            top = self.group()
            return top / self.group()
        if token == r"\left(":
            value = self.sum()
            assert self.next(r"\right)")
            return value
        return self.x[int(token[3])] if token.startswith("x") else float(token)


def test_formulas_read_back_have_the_values_they_stand_for():
    rng = np.random.default_rng(7)
    operations = (*BINARY[:3], lambda a, b: a / b, lambda a, b: -a, lambda a, b: a**2, lambda a, b: a**3, lambda a, b: 1 / a)

    def polynomial(depth):
        if depth == 0:
            return X[int(rng.integers(3))] if rng.random() < 0.7 else ca.SX(float(rng.choice([2.0, -3.0, 0.5, -0.25])))
        return operations[rng.integers(len(operations))](polynomial(depth - 1), polynomial(depth - 1))

    compared = 0
    while compared < 400:
        expr, at = polynomial(int(rng.integers(1, 5))), rng.uniform(0.5, 2, 3)
        if not small(expr, at):
            continue
        latex = formulas(expr, PLAIN)[0]
        if "ldots" in latex:  # a number that was cut
            continue
        reader = Reader(latex, at)
        assert reader.sum() == pytest.approx(float(ca.Function("value", [X], [expr])(at)), rel=1e-9, abs=1e-9), (expr, latex)
        assert not reader.tokens, latex
        compared += 1


def test_a_norm_of_a_whole_vector_is_written_with_the_vector():
    names = SymbolNames({}, {"x": ["x_0", "x_1", "x_2"]})
    c = ca.vertcat(1, -2, ca.SX.sym("t"))
    assert formulas(ca.norm_2(X - c) - 1, names) == [r"\left\Vert x - \left(1,\ -2,\ t\right) \right\Vert - 1"]
    assert formulas(2 * ca.norm_2(X), names) == [r"2\,\left\Vert x \right\Vert"]
    swapped = ca.norm_2(X[[1, 0, 2]])
    assert formulas(swapped, names) == [r"\left\Vert \left(x_{1},\ x_{0},\ x_{2}\right) \right\Vert"]


def test_long_formulas_are_counted_not_written():
    expr = X[0]
    for _ in range(60):
        expr = ca.sin(expr) + expr
    start = time.perf_counter()
    (latex,) = formulas(expr, PLAIN)
    assert re.fullmatch(r"\\left\[\\text\{\d+ operations\}\\right\]", latex)
    assert time.perf_counter() - start < 0.5


@pytest.mark.parametrize(
    ("value", "latex"),
    [
        (0.1, "0.1"), (-2.0, "-2"), (3.9000000000000004, "3.9"), (1e-6, "10^{-6}"), (-1e6, "-10^{6}"),
        (2.5e-7, r"2.5\cdot 10^{-7}"), (1200000.0, "1200000"), (np.sqrt(2), r"\sqrt{2}"), (-np.pi / 3, r"-\frac{\pi}{3}"),
        (100 / 3, r"\frac{100}{3}"), (1 / 7, r"\frac{1}{7}"), (0.123456789, r"0.123456\ldots"), (np.inf, r"\infty"),
        (-np.inf, r"-\infty"), (3.14159, "3.14159"), (1.4142, "1.4142"), (0.00012345678, r"0.000123456\ldots"),
    ],
)  # fmt: skip
def test_numbers_are_those_the_user_wrote(value, latex):
    assert number_latex(value) == latex


def test_numbers_read_back_are_right_to_the_digits_shown():
    rng = np.random.default_rng(3)
    values = [*(rng.uniform(1, 10, 500) * 10.0 ** rng.integers(-12, 13, 500)), 99999999.5, 0.99999999, 123456.5, 5e-324, 1.7e308]
    for value in values:
        latex = number_latex(value)
        root, _, power = latex.replace(r"\ldots", "").partition(r"\cdot 10^")
        again = float(f"{root}e{power.strip('{}') or 0}")
        assert again == pytest.approx(value, rel=0 if "ldots" not in latex else 1e-5), latex


@pytest.mark.parametrize(
    ("name", "latex"),
    [
        ("mu1", r"\mu_{1}"), ("q_0", "q_{0}"), ("v_C", "v_{C}"), ("heater", r"\mathit{heater}"),
        ("x1_dot", r"x_{1,\mathrm{dot}}"),
        ("lambda", r"\lambda"), ("phi_tau_2", r"\phi_{\tau,2}"), ("50% full", r"\text{50\% full}"),
    ],
)  # fmt: skip
def test_names_become_symbols(name, latex):
    assert symbol_latex(name) == latex


# -- equations ---------------------------------------------------------------------------------------------------------


def rendered(latex):
    """Draw a formula with Matplotlib; the rows of matrices and cases, which it does not know, one entry at a time."""
    from matplotlib.mathtext import MathTextParser

    parser = MathTextParser("agg")
    environment = re.compile(r"\\begin\{(\w+)\} (.*?) \\end\{\1\}")
    while (found := environment.search(latex)) is not None:
        for cell in re.split(r" \\\\ | & ", found[2]):
            rendered(cell)
        latex = latex.replace(found[0], "M")
    for command, known in ((r"\vdots", r"\cdots"), (r"\left[\text", r"\text"), (r"}\right]", "}")):
        latex = latex.replace(command, known) if "operations" in latex or "vdots" in command else latex
    parser.parse(f"${latex}$")


def balanced(latex):
    plain = re.sub(r"\\[{}]", "", latex)
    depths = np.cumsum([{"{": 1, "}": -1}.get(letter, 0) for letter in plain])
    return not depths.size or (depths.min() >= 0 and depths[-1] == 0 and latex.count(r"\left") == latex.count(r"\right"))


def test_equations_of_every_case_can_be_drawn(case_file, load_case):
    model = load_case(case_file.stem)
    lines = model_equations(model)
    assert len(lines) >= 3
    for line in lines:
        assert "\n" not in line
        assert "$" not in line
        assert balanced(line), line
        rendered(line)
    if model.p.numel():
        bound = model_equations(model.bind())
        for name in model.parameters:
            assert any(symbol_latex(name) in line for line in lines), name
            assert not any(symbol_latex(name) in line for line in bound), name


def test_unbalanced_formulas_are_seen():
    assert not balanced(r"\frac{1}{2")
    with pytest.raises(ValueError, match="Unknown symbol"):
        rendered(r"\frac{1}{2} \nosuchcommand")


def test_constraints_are_written_under_their_names_and_counted():
    q = ca.SX.sym("q", 2)
    walls = {f"wall {i} of 50_%": q[0] + i for i in range(9)}
    lines = model_equations(SweepingProcess(q=q, f=[0, 1], constraints={"both": q, **walls}, q0=[0, 0], t_end=1))
    assert lines[:2] == [r"\dot{q} + N_{Q}(q) \ni f(q)", r"f(q) = \left(0,\ 1\right)"]
    assert r"g_{\text{both[1]}}(q) = q_{1} \geq 0" in lines
    assert r"g_{\text{wall 1 of 50\_\%}}(q) = q_{0} + 1 \geq 0" in lines
    assert r"\vdots \quad \text{(11 constraints)}" in lines
    assert not any("wall 2" in line for line in lines)


def test_states_are_written_under_the_users_names():
    lines = model_equations(
        LureSystem(A=[[0, 1], [-1, 0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[1, 0], t_end=1, names=["s", "mu_1"])
    )
    assert r"x = \left(s,\ \mu_{1}\right)" in lines
    z = ca.SX.sym("z", 2)
    lines = model_equations(
        LureSystem(x=z, A=[z[1], -ca.sin(z[0])], B=[0, 1], C=[0, 1], law=relay(1), x0=[1, 0], t_end=1, names=["s", "mu_1"])
    )
    assert r"A(x) = \left(\mu_{1},\ -\sin\left(s\right)\right)" in lines


@pytest.mark.parametrize(
    ("law", "latex"),
    [
        (relay(1), r"K = \left[-1,\ 1\right] \quad \left(\lambda \in -\mathrm{Sgn}\left(y\right)\right)"),
        (complementarity(3), r"K = \left[0,\ \infty\right)^{3} \quad \left(0 \leq y_i \perp \lambda_i \geq 0\right)"),
        (equality(2), r"K = \mathbb{R}^{2} \quad \left(y_i = 0\right)"),
        (box(-np.inf, 0.5), r"K = \left(-\infty,\ 0.5\right]"),
        (ball(2, 3), r"K = \left\{ \lambda \in \mathbb{R}^{2} : \left\Vert \lambda \right\Vert \leq 3 \right\}"),
        (
            product(relay(2), complementarity(1), relay(1)),
            r"K = \left[-1,\ 1\right]^{2} \times \left[0,\ \infty\right) \times \left[-1,\ 1\right]",
        ),
    ],
)
def test_laws_are_written_as_sets(law, latex):
    assert law_latex(law) == latex


def test_every_kind_of_law_can_be_drawn():
    for law in (cone(3), polyhedron([[1, 0], [1, 1]], [0, -1]), product(*[relay(1, 0, i + 1) for i in range(20)]), product()):
        assert balanced(law_latex(law))
        rendered(law_latex(law))


# -- the report --------------------------------------------------------------------------------------------------------

IDS = ("A5", "S-convex", "5.4a", "run-contraction")


def some_report(seed, names=3):
    """A report with every verdict, long text, long vectors, infinities and markup in names."""
    rng = np.random.default_rng(seed)
    words = "the gradients |grad g_i| of <near> constraints * oppose _each_ other; 0 in int A(0), `x` [2] {q : g >= 0} $5".split()

    def some(k):
        return " ".join(rng.choice(words, k))

    findings = []
    for id, verdict in zip(IDS, VERDICTS, strict=True):
        value = {f"number {i}": float(rng.normal() * 10.0 ** rng.integers(-9, 9)) for i in range(rng.integers(1, 9))}
        value |= {"sup": float(rng.choice([np.inf, 0.0, -np.inf]))} if verdict not in (UNKNOWN, HOLDS) else {}
        witness = {"q": rng.normal(size=rng.integers(1, 60)), "constraints": [some(3)] * names, "count": 3, "of": None}
        source = Hypothesis(id, some(rng.integers(3, 60)), some(4))
        findings.append(make_finding(source, verdict, some(rng.integers(3, 60)), value, witness))
    following = [
        make_consequence(name, some(20), findings, rests, some(3), {"K_L": float(rng.normal())})
        for name, rests in (("K_L", ["S-convex"]), ("the order that is proved", ["A5", "S-convex"]), ("empty", []))
    ]
    return Report(
        "A title", "SweepingProcess", some(12), some(40), True, tuple(findings), tuple(following), {"a": 0.1, "b": None},
        (some(30),), None,
    )  # fmt: skip


@pytest.mark.parametrize("width", [72, 100, 140])
@pytest.mark.parametrize("seed", range(5))
def test_no_line_is_wider_than_asked(seed, width):
    lines = report_text(some_report(seed), width).splitlines()
    assert max(map(len, lines)) <= width
    assert all(line == line.rstrip() for line in lines)


def test_a_word_without_a_space_is_broken():
    report = some_report(0)
    finding = make_finding(Hypothesis("A5", "s" * 300, "x" * 200), VIOLATED, "h" * 300, {"n" * 150: 1.0}, {"w": ["c" * 300]})
    wide = Report("t" * 150, "M", "p" * 150, "r" * 150, False, (finding,), report.consequences, {"p" * 120: 1.0}, (), None)
    assert max(map(len, report_text(wide).splitlines())) <= 100


@pytest.mark.parametrize("seed", range(5))
def test_table_page_and_data_say_the_same(seed, load_case):
    report = some_report(seed)
    data = loads(dumps(report_data(report)))
    table = " ".join(report_text(report).split())
    page = re.sub(r"\\([^A-Za-z0-9\s])", r"\1", markdown(report, load_case("moving_disc")))
    assert [item["id"] for item in data["findings"]] == [finding.id for finding in report.findings]
    for item, finding in zip(data["findings"], report.findings, strict=True):
        assert item["verdict"] == finding.verdict
        assert item["value"] == dict(finding.value)
        assert item["witness"] == dict(finding.witness)
        block = re.search(
            rf"(^|\s){re.escape(finding.id)} +{finding.verdict} .*?{re.escape(' '.join(finding.how.split()))}", table
        )
        (row,) = (line for line in page.splitlines() if line.startswith(f"| **{finding.id}** |"))
        assert block, finding.id
        assert f"| {finding.verdict} |" in row
        for name, number in item["value"].items():
            assert f"{name} = {number:.5g}" in block[0]
            assert f"{name} = {number:.5g}" in row
        witnessed = finding.verdict in (VIOLATED, SAMPLED)
        assert ("count = 3" in block[0]) == witnessed == ("count = 3" in row)
    for item, consequence in zip(data["consequences"], report.consequences, strict=True):
        assert item["rests_on"] == list(consequence.rests_on)
        assert f"K_L = {consequence.value['K_L']:.5g}" in table
        assert f"| **{consequence.name}** |" in page
    assert all(" ".join(note.split()) in table for note in report.notes)
    assert "b = no value" in table


def test_data_is_strict_json_with_infinities_as_text():
    report = some_report(0)
    finding = make_finding(Hypothesis("A5", "s", "x"), VIOLATED, "h", {"gamma": np.inf, "a": 1.0}, {"u": [np.nan, 1]})
    data = report_data(Report("t", "M", "p", "r", False, (finding,), (), {}, (), None))

    def refuse(constant):
        raise AssertionError(constant)

    plain = json.loads(dumps(data), parse_constant=refuse)
    assert plain["findings"][0]["value"] == {"gamma": "inf", "a": 1.0}
    assert plain["findings"][0]["witness"] == {"u": ["nan", 1]}
    assert json.loads(dumps(report_data(report)), parse_constant=refuse)["verdict"] == report.verdict


def test_page_is_a_table_that_github_reads(load_case):
    page = markdown(some_report(3), load_case("two_masses"))
    rows = [line for line in page.splitlines() if line.startswith("|")]
    columns = [len(re.findall(r"(?<!\\)\|", row)) - 1 for row in rows]
    assert columns[:2] == [7, 7]
    assert set(columns) == {7}
    blocks = re.findall(r"^\$\$\n(.*)\n\$\$$", page, re.MULTILINE)
    assert len(blocks) == len(model_equations(load_case("two_masses")))
    assert not any(re.search(r"\\[^A-Za-z\s]", block) for block in blocks)  # Markdown would take the backslash away.
    assert any(r"\cr" in block for block in blocks)


def test_witnesses_are_short():
    assert witness_value_text([0.1234567, 2, "wall"]) == "(0.12346, 2, wall)"
    assert witness_value_text(list(range(60))) == "(0, 1, 2, 3, ..., 59; 60 entries)"
    assert witness_value_text([[1, 2], [3, 4]]) == "((1, 2), (3, 4))"
    many = {"constraint": "wall"} | {f"q_{i}": float(i) for i in range(60)}
    finding = make_finding(Hypothesis("A5", "s", "x"), VIOLATED, "h", {"gamma": np.inf}, many)
    report = Report("t", "M", "p", "r", False, (finding,), (), {}, (), None)
    assert "constraint = wall, q_0 = 0" in report_text(report)
    assert "... (61 entries)" in report_text(report)
    assert "q_20" not in report_text(report)
    assert report_data(report)["findings"][0]["witness"] == many


def test_a_number_that_is_none_is_not_printed():
    finding = make_finding(Hypothesis("A5", "s", "x"), HOLDS, "h", {"margin": np.nan, "a": 1.0})
    assert dict(finding.value) == {"a": 1.0}
    with pytest.raises(ValueError, match="'holds' needs a reason, a number"):
        make_finding(Hypothesis("A5", "s", "x"), HOLDS, "h", {"margin": np.nan})
