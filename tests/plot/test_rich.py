"""What notebooks show: HTML of results, figures that show themselves, bars; reprs of a few lines."""

import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser

import casadi as ca
import numpy as np
import pytest

import nsmodel
from nsmodel import LureSystem, SweepingProcess, relay, simulate
from nsmodel.plot.html import elements
from nsmodel.plot.html.elements import mathml

EVIL = '</script><b>$x$ & "\u202e'
VOID = {"br", "img", "meta"}


class Reader(HTMLParser):
    """Elements, classes and text of a page; refuses what is not closed."""

    def __init__(self, text):
        super().__init__()
        self.open, self.seen, self.classes, self.words = [], set(), [], []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.seen.add(tag)
        self.classes += [value for name, value in attrs if name == "class"]
        assert not any(name.startswith("on") or "javascript:" in (value or "") for name, value in attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self):
        return "".join(self.words)


def safe(result):
    """The page of a result, in which nothing can run, and no formula is looked for."""
    found = Reader(result._repr_html_())
    assert not found.seen & {"script", "iframe", "object", "link", "b" if "What follows" not in found.text else ""}
    assert "mathjax_ignore" in found.classes[0]
    assert found.open == []
    return found


@pytest.fixture(scope="module")
def evil():
    """A model whose every name would break a page."""
    x, k, u = ca.SX.sym("x", 2), ca.SX.sym("k"), ca.SX.sym("u")
    return LureSystem(
        x=x, A=[x[1], -k * x[0]], B=[0, 1], C=[0, 1], f=[0, u], law={f"{EVIL} 2": relay(1)}, x0=[1, 0],
        t_end=0.2, step=0.05, title=EVIL, names=[EVIL, "speed"], units={"k": EVIL, "t": EVIL}, parameters={k: 2.0},
        inputs={u: nsmodel.table([0, 1], [0.1, 0.1])},
    )  # fmt: skip


@pytest.fixture(scope="module")
def run():
    x = ca.SX.sym("x", 2)
    return simulate(LureSystem(x=x, A=[x[1], -x[0]], B=[0, 1], C=[0, 1], law=relay(1), x0=[3, 0], t_end=4, step=0.01))


# -- the page ----------------------------------------------------------------------------------------------------------


def test_text_is_escaped_in_one_place():
    assert elements.escape_text("</script><b>") == "&lt;/script&gt;&lt;b&gt;"
    assert elements.escape_text("$x$") == "<span>$</span>x<span>$</span>"
    shown = Reader(
        elements.result_page(
            EVIL,
            EVIL,
            EVIL,
            elements.facts_table([(EVIL, [EVIL])]),
            elements.folded_section(EVIL, EVIL),
            elements.status_badge(EVIL),
        )
    )
    assert shown.seen == {"div", "style", "span", "table", "tbody", "tr", "th", "td", "details", "summary"}
    assert shown.text.count('</script><b>$x$ & "') == 8
    assert "\u202e" not in shown.text


def test_a_verdict_is_a_colour_a_mark_and_a_word():
    found = {word: Reader(elements.status_badge(word)) for word in ("holds", "sampled", "violated", "unknown")}
    assert [one.text for one in found.values()] == ["✓ holds", "≈ sampled", "✗ violated", "? unknown"]
    assert len({one.classes[0] for one in found.values()}) == 4


def luminance(colour):
    channels = [int(colour[i : i + 2], 16) / 255 for i in (0, 2, 4)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_words_stand_out_from_the_colours_of_verdicts():
    """By the contrast of WCAG, 4.5 at least."""
    pairs = re.findall(r"\{background:#(\w+);color:#(\w+)\}", elements.STYLE)
    assert len(pairs) == 4
    for pair in pairs:
        dark, light = sorted(luminance(c if len(c) == 6 else "".join(2 * x for x in c)) for c in pair)
        assert (light + 0.05) / (dark + 0.05) >= 4.5


# -- formulas ----------------------------------------------------------------------------------------------------------


def test_formulas_are_mathml():
    tree = ET.fromstring(mathml(r"\ddot{x}_{i} = \frac{-a^{2}}{\sqrt{b}},\quad \left\Vert q \right\Vert \leq 0.5"))
    assert [part.tag for part in tree.iter("msub")] == ["msub"]
    assert tree.find(".//mover")[1].text == "¨"
    over, under = tree.find(".//mfrac")
    assert over.find("mo").attrib == {"form": "prefix"}
    assert "".join(over.itertext()) == "−a2"
    assert under.find("msqrt") is not None
    assert "".join(tree.itertext()).replace(" ", "").endswith("‖q‖≤0.5")
    rows = ET.fromstring(mathml(r"A = \begin{pmatrix} 1 & 0 \\ \mathit{ab} & x_1^2 \end{pmatrix}")).find(".//mtable")
    assert [["".join(cell.itertext()) for cell in row] for row in rows] == [["1", "0"], ["ab", "x12"]]
    words = ET.fromstring(mathml(r"\text{a\_b <\$> \backslash c}"))
    assert "".join(words.itertext()).replace("\xa0", " ") == "a_b <$> \\c"
    assert "".join(ET.fromstring(mathml(r"\unheard{x}")).itertext()) == "unheardx"


def test_models_of_all_cases_show_their_equations(case_file, load_case):
    """Every formula is well formed, and no command is left that the reader of LaTeX does not know."""
    from nsmodel.hypotheses.equations import model_equations
    from nsmodel.plot.html import elements as reader

    model = load_case(case_file.stem)
    lines = model_equations(model)
    known = {*reader.LETTERS, *reader.SIGNS, *reader.FUNCTION_NAMES, *reader.SPACES, *reader.ACCENTS, *reader.LETTER_STYLES}
    known |= {"left", "right", "text", "frac", "sqrt", "mathbb", "begin", "end", "backslash"}
    assert {name for line in lines for name in re.findall(r"\\([A-Za-z]+)", line)} <= known
    for line in lines:
        ET.fromstring(mathml(line))
    found = safe(model)
    assert "math" in found.seen
    assert model.title in found.text
    assert len(model._repr_html_()) < 50_000
    parts = [*model.blocks, *model.inputs.values(), *([model.law] if getattr(model, "law", None) else [])]
    for one in (model, *parts):
        lines = repr(one).splitlines()
        assert len(lines) <= 10
        assert max(map(len, lines)) <= 100
    assert repr(model).startswith(f"{type(model).__name__}: {model.title}\n  states ")


def test_a_model_of_a_thousand_states_is_short_and_quick():
    import time

    n = 1000
    q = ca.SX.sym("q", n)
    model = SweepingProcess(
        q=q, f=-q + ca.vertcat(q[1:], 0), constraints={"gap": q[1:] - q[:-1], "wall": q[0]}, q0=np.arange(n) / 7,
        t_end=1, step=0.1,
    )  # fmt: skip
    model._repr_html_()  # what is imported at first use
    start = time.process_time()
    text = model._repr_html_()
    assert time.process_time() - start < 0.3
    assert len(text) < 50_000
    found = Reader(text).text
    assert "1000: q_0, q_1, " in found
    assert "(1000 constraints)" in found.replace("\xa0", " ")


# -- results -----------------------------------------------------------------------------------------------------------


def test_names_of_the_user_are_text(evil):
    shown = safe(evil)
    assert shown.text.count("</script><b>") >= 4
    run = simulate(evil)
    found = safe(run)
    assert "img" in found.seen
    assert "✓ done" in found.text
    report = nsmodel.check(evil, runs=[run], quick=True)
    assert {"table", "details"} <= safe(report).seen
    assert report.findings[0].statement[:20] in safe(report).text


def test_a_run_says_how_it_ended_and_shows_its_states(run):
    found = safe(run)
    for row in ("✓ done", "400, t = 0 to 4", f"{run.summary()['residual']['worst']:.3g}", "img"):
        assert row in found.text or row in found.seen
    run = nsmodel.Trajectory(run.arrays, run.metadata | {"status": "failed", "message": "step 7: no", "warnings": list("abcdef")})
    found = safe(run)
    assert "✗ failed" in found.text
    assert "step 7: no" in found.text
    assert "2 more warnings" in found.text


def test_a_picture_that_fails_breaks_nothing(run, monkeypatch):
    from nsmodel.plot import figures

    monkeypatch.setattr(figures, "thumbnail", lambda run: 1 / 0)
    found = safe(run)
    assert "no picture: ZeroDivisionError: division by zero" in found.text
    assert "img" not in found.seen
    assert "✓ done" in found.text


def test_violated_findings_come_first_and_long_ones_fold(evil):
    def finding(id, verdict, how="by hand"):
        return nsmodel.Finding(id, "a statement", verdict, {"c": 2.0}, {"x": [1.0]}, "a paper, 1", how)

    findings = [finding(f"A{k}", "holds") for k in range(20)] + [finding("B", "violated", "very long " * 40)]
    report = nsmodel.Report("title", "LureSystem", "paper", "a box", False, tuple(findings), (), {}, (), evil)
    text = safe(report).text
    assert "20 proved" in text
    assert "✗ 1 violated" in text
    assert text.index("✗ violated") < text.index("✓ holds")
    assert "7 more findings" in text
    assert text.count("very long ") > 40


def test_studies_sweeps_and_stress(run):
    from nsmodel.study import Line, Point, Study
    from nsmodel.study.stress import Cell, Stress

    points = (Point("h = 0.1", 1e-3, {"max": 0.25}, step=0.1), Point("h = 0.05", 2e-3, {"max": 0.125}, step=0.05))
    lines = (Line("implicit", (*points, Point.failed("h = 0.01", EVIL))), Line("lemke", points, kind="solver"))
    found = safe(Study(EVIL, "LureSystem", 2, 1.0, "s", lines, None, notes=(EVIL,)))
    assert "2 of 3" in found.text
    assert "1.00" in found.text
    assert "0.12 to 0.25" in found.text
    assert "1 solvers alone" in found.text
    assert "img" in found.seen
    came = (("wrong", 7.0), ("right", 0.5))
    cells = [Cell({"k": 1.0}, 1.0, 0.1, 1.0, 1.0, verdict, {"a": ratio}, EVIL, 3) for verdict, ratio in came]
    found = safe(Stress(EVIL, "LureSystem", ("x",), "", 0.1, tuple(cells)))
    assert "a: 7 times what is allowed" in found.text
    assert "0 stopped" in found.text
    k, x = ca.SX.sym("k"), ca.SX.sym("x", 1)
    model = LureSystem(x=x, A=[-k * x], B=[1], C=[1], law=relay(1), x0=[1], t_end=0.2, step=0.1, parameters={k: 1.0}, title=EVIL)
    sweep = nsmodel.sweep(model, grid={k: [1.0, 2.0, 4.0]}, outputs={"last": "x[-1]"}, compiled=False, workers=1)
    found = safe(sweep)
    assert "✓ 3 done" in found.text
    assert "k: 3, 1 to 4" in found.text
    assert "img" in found.seen
    for one in (nsmodel.statistics(sweep.last), nsmodel.share(sweep.last > 0)):
        assert one.text.partition("\n")[2] in safe(one).text
    sweep.cells["status"][1] = 1
    sweep.messages[1] = EVIL
    assert "✗ 1 failed" in safe(sweep).text
