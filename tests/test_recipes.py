"""The recipes of docs/architecture.md: followed to the letter in a copy of the tree, each gives what it promises.

A recipe names its places, a line each. A test adds something at all of these and at no other, and runs its own small tests there.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
PARTS = ("nsmodel", "tests", "docs", "cases", "pyproject.toml")
NOT_COPIED = shutil.ignore_patterns("__pycache__", "gallery", "fixtures", "bench", "images", "notebooks")


class Recipe(NamedTuple):
    """What is added in a copy of the tree.

    Attributes:
        heading: of the recipe.
        names: what stands for the words in capitals of its places.
        added: {place: text of a new file, or {line or part of one: what stands there afterwards}}.
        optional: places that the recipe names for other things than this one.
        tests: what must pass there: the text of a file of tests, and arguments of pytest for those that the tree has.
    """

    heading: str
    names: Mapping[str, str]
    added: Mapping[str, str | Mapping[str, str]]
    optional: frozenset[str]
    tests: tuple[str, list[str]]


LAW = '''
"""The ball of the 1-norm {|l_1| + ... + |l_m| <= r}: l = -r sign(y_i) e_i where |y_i| is the largest entry of y."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar

import casadi as ca
import numpy as np

from nsmodel._utils import short_repr
from nsmodel.errors import ModelError
from nsmodel.modeling.laws.base import Halfspaces, LatexNumberWriter, Law, LawFactor, RewrittenLaw, StateNames, product_set
from nsmodel.modeling.laws.polyhedron import Polyhedron


@dataclass(frozen=True, eq=False)
class L1Ball(LawFactor):
    """{|l|_1 <= radius}; ``radius`` a number."""

    kind: ClassVar[str] = "l1_ball"
    STATE_NAMES: ClassVar[Mapping[str, StateNames]] = {}
    radius: float

    __repr__ = short_repr

    @property
    def polyhedron(self) -> Polyhedron:
        """The same set by its faces, one for each choice of signs."""
        signs = np.array(list(product((-1.0, 1.0), repeat=self.size)))
        return Polyhedron(self.label, self.size, signs, np.full(len(signs), -self.radius))

    def scaled(self, u: float) -> L1Ball:
        """The radius times u."""
        return replace(self, radius=u * self.radius)

    def rewritten(self, y: ca.SX, names: tuple[str, ...], moving: ca.SX, *, guarded: bool = True) -> RewrittenLaw:
        """As its faces are rewritten."""
        return self.polyhedron.rewritten(y, names, moving, guarded=guarded)

    def shape(self) -> Halfspaces:
        """The faces, which are exact."""
        return self.polyhedron.shape()

    @property
    def width(self) -> float:
        """The distance between two faces that are opposite."""
        return 2 * self.radius / np.sqrt(self.size)

    def bounding_box(self) -> tuple[np.ndarray, np.ndarray]:
        """A cube."""
        return np.full(self.size, -self.radius), np.full(self.size, self.radius)

    def excess(self, l: np.ndarray) -> np.ndarray:
        """By how much |l|_1 is larger than the radius."""
        return np.maximum(np.abs(l).sum(axis=1, keepdims=True) - self.radius, 0)

    def rivals(self, l: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The corner against the largest entry of y."""
        rows, largest, found = np.arange(len(y)), np.abs(y).argmax(axis=1), np.zeros(np.shape(l))
        found[rows, largest] = -self.radius * np.sign(y[rows, largest])
        return found[None]

    @property
    def extent(self) -> float:
        """The radius."""
        return self.radius

    def latex(self, write: LatexNumberWriter) -> list[str]:
        """|lambda|_1 <= r."""
        return [product_set(write, self.size, rf"\\left\\Vert \\lambda \\right\\Vert_1 \\leq {write.number(ca.SX(self.radius))}")]

    def data(self) -> dict[str, Any]:
        """The radius."""
        return {"radius": self.radius}


def l1_ball(m: int, radius: float = 1.0) -> Law:
    """-y ∈ N(l) for {|l_1| + ... + |l_m| <= radius}: one budget for all components, spent where y is largest.

    Raises:
        ModelError: m < 1, a radius that is negative or not finite.
    """
    if m < 1 or not 0 <= radius < np.inf:
        raise ModelError(f"l1_ball: m = {m}, radius = {radius:g}; expected m >= 1 and a finite radius >= 0")
    return Law((L1Ball("l1 ball", m, float(radius)),))
'''
LAW_TEST = '''
import numpy as np
import pytest

from nsmodel import LureSystem, l1_ball, simulate


@pytest.mark.parametrize("compiled", [False, True])
def test_the_largest_state_is_braked_first(compiled):
    """x' = l, y = x: x_1 = 1 - t until both are equal, then both fall at half the rate, and rest at 0 from t = 3/2 on."""
    eye = np.eye(2)
    model = LureSystem(A=0 * eye, B=eye, C=eye, law=l1_ball(2), x0=[1, 0.5], t_end=2, step=0.01)
    run = simulate(model, compiled=compiled)
    np.testing.assert_allclose(run.x[[25, 100, 200]], [[0.75, 0.5], [0.25, 0.25], [0, 0]], atol=1e-13)
'''

HYPOTHESIS = """
F_MASS = Hypothesis("F-mass", "M is positive definite", f"{SICONOS_NOTES}, linearization of the first line")
HYPOTHESES = (F_JACOBIANS, F_W, F_MLCP, F_UNIQUE, F_STEP, F_MASS)
"""
HYPOTHESIS_FUNCTION = '''
def _check_mass(model: FirstOrderSystem) -> Finding:
    """Decide exactly whether (M + M')/2 is positive definite."""
    M = np.array(ca.DM(model.M)).reshape(model.M.shape)
    values, vectors = np.linalg.eigh((M + M.T) / 2)
    value = {"least eigenvalue": values[0]}
    if exact.definiteness(M).definite:
        return make_finding(F_MASS, HOLDS, "exact, by L D L'.", value)
    return make_finding(F_MASS, VIOLATED, "exact, by L D L'.", value, {"v with v'M v <= 0": vectors[:, 0]})


# -- F-jacobians --'''
HYPOTHESIS_TEST = """
import json

import casadi as ca
import pytest

from nsmodel import FirstOrderSystem, check
from nsmodel.cli import main


def report_of(M):
    x = ca.SX.sym("x", 2)
    return check(FirstOrderSystem(x=x, f=-x, M=M, x0=[1, 1], t_end=0.1, step=0.05))


@pytest.mark.parametrize(("M", "verdict"), [([[2, 1], [1, 2]], "holds"), ([[1, 2], [2, 1]], "violated")])
def test_a_mass_matrix_is_judged_exactly(M, verdict):
    report = report_of(M)
    assert report["F-mass"].verdict == verdict
    assert report["F-mass"].value["least eigenvalue"] == pytest.approx(1 if verdict == "holds" else -1)
    assert "M is positive definite" in report.text()


def test_it_holds_for_all_values_of_a_parameter():
    x, m = ca.SX.sym("x", 2), ca.SX.sym("m")
    model = FirstOrderSystem(x=x, f=-m * x, x0=[1, 1], t_end=0.1, step=0.05, parameters={m: 1.0})
    assert check(model, parameters={"m": (1, 2)})["F-mass"].verdict in ("holds", "sampled")


def test_a_certificate_says_that_it_has_no_proof_of_it(tmp_path, capsys):
    file = tmp_path / "model.py"
    file.write_text(
        "import casadi as ca\\nfrom nsmodel import FirstOrderSystem\\nx = ca.SX.sym('x')\\n"
        "model = FirstOrderSystem(x=x, f=-x, x0=[1], t_end=0.1, step=0.05)\\n"
    )
    main(["check", str(file), "--certificate", str(tmp_path / "certificate")])
    statements = json.loads((tmp_path / "certificate" / "certificate.json").read_text())["statements"]
    assert [one["proof"] for one in statements if one["id"] == "F-mass"] == [None]
"""

OPTION = """
    remark: str = option(
        "",
        "a text that the run keeps in its metadata.",
        flag=flag("--remark", {"run": "a text that the run keeps"}, default="", metavar="TEXT"),
    )

    def __post_init__(self)"""
OPTION_TEST = """
import inspect

import pytest

import nsmodel
from nsmodel.cli import main

MODEL = (
    "import casadi as ca\\nfrom nsmodel import FirstOrderSystem\\nx = ca.SX.sym('x')\\n"
    "model = FirstOrderSystem(x=x, f=-x, x0=[1], t_end=0.1, step=0.05)\\n"
)


def test_simulate_takes_it_and_says_so(tmp_path):
    (tmp_path / "model.py").write_text(MODEL)
    assert nsmodel.simulate(nsmodel.load(tmp_path / "model.py"), remark="first").metadata["remark"] == "first"
    assert "remark: a text that the run keeps" in inspect.getdoc(nsmodel.simulate)
    assert inspect.signature(nsmodel.simulate).parameters["remark"].default == ""
    with pytest.raises(TypeError, match="remark"):
        nsmodel.explain(None, remark="")


def test_it_is_a_flag(tmp_path, capsys):
    (tmp_path / "model.py").write_text(MODEL)
    main(["run", str(tmp_path / "model.py"), "--remark", "second", "--out", str(tmp_path / "out")])
    assert nsmodel.Trajectory.load(tmp_path / "out" / "trajectory.npz").metadata["remark"] == "second"
"""

BLOCK = '''
def peak_hold(w: Any, y: Any, *, start: float, period: float | None = None) -> Block:
    """``w`` is the largest value that y has had.

    Args:
        w: its symbol; y: an expression; start: w before the start.
        period: of its ticks; left out: each step.
    """
    w = _scalar_symbol(w)
    return _memory_block(f"peak hold {w}", period, {w: start}, {w: ca.fmax(w, y)}, {})


def dead_time('''
BLOCK_TEST = """
import casadi as ca
import numpy as np
import pytest

from nsmodel import FirstOrderSystem, peak_hold, simulate
from nsmodel.codegen import write


def model():
    t, x, w = ca.SX.sym("t"), ca.SX.sym("x"), ca.SX.sym("w")
    return FirstOrderSystem(
        t=t, x=x, f=[ca.cos(t)], x0=[0], blocks=[peak_hold(w, x, start=0, period=0.1)], outputs={"peak": w}, t_end=4, step=0.1
    )


@pytest.mark.parametrize("given", [{}, {"compiled": True}, {"rtol": 1e-8}])
def test_the_largest_value_is_held(given):
    run = simulate(model(), **given)
    at_ticks = np.ravel(run.x) if "rtol" not in given else np.ravel([run.at(0.1 * k).x for k in range(41)])
    assert run.arrays["peak"][-1] == pytest.approx(at_ticks.max(), abs=1e-9)


def test_it_is_exported(tmp_path):
    assert write(model(), tmp_path)
"""

RECIPES = [
    Recipe(
        "A law",
        {"NAME": "l1_ball"},
        {
            "nsmodel/modeling/laws/NAME.py": LAW,
            "nsmodel/modeling/laws/__init__.py": {
                "from nsmodel.modeling.laws.polyhedron": "from nsmodel.modeling.laws.l1_ball import L1Ball, l1_ball\n"
                "from nsmodel.modeling.laws.polyhedron",
                "Ellipsoid, Coulomb)": "Ellipsoid, Coulomb, L1Ball)",
                '    "polyhedron",\n': '    "l1_ball",\n    "polyhedron",\n',
            },
            "nsmodel/__init__.py": {"    equality,\n": "    equality,\n    l1_ball,\n", '"latch",': '"l1_ball",\n    "latch",'},
            "tests/modeling/test_kinds_of_laws.py": {
                "    ellipsoid,\n": "    ellipsoid,\n    l1_ball,\n",
                "EXAMPLES = {\n": 'EXAMPLES = {\n    "l1_ball": l1_ball(2, 0.5),\n',
            },
            "docs/guide.md": {"| `polyhedron(H, K)`": "| `l1_ball(m, radius)` | abs(l)_1 <= radius | | |\n| `polyhedron(H, K)`"},
            "docs/api/laws.md": {".. autofunction:: product": ".. autofunction:: l1_ball\n.. autofunction:: product"},
        },
        frozenset({"nsmodel/modeling/laws/NAME.c"}),
        (LAW_TEST, ["tests/modeling/test_kinds_of_laws.py", "-k", "l1_ball or example or largest"]),
    ),
    Recipe(
        "A hypothesis",
        {"CLASS": "first_order_system"},
        {
            "nsmodel/models/CLASS/check.py": {
                "HYPOTHESES = (F_JACOBIANS, F_W, F_MLCP, F_UNIQUE, F_STEP)\n": HYPOTHESIS.lstrip(),
                "        step,\n    ]\n": "        step,\n        _check_mass(at.model),\n    ]\n",
                "# -- F-jacobians --": HYPOTHESIS_FUNCTION.lstrip(),
            },
            "docs/hypotheses.md": {"### F-mlcp": "### F-mass The mass matrix is positive definite\n\nExact.\n\n### F-mlcp"},
        },
        frozenset({"nsmodel/models/CLASS/inputs_and_parameters.py", "nsmodel/models/CLASS/documents.py",
                   "nsmodel/hypotheses/certificates/verify.py"}),
        (HYPOTHESIS_TEST, ["tests/hypotheses/test_check_cases.py", "-k", "mass or parameter or certificate or paragraph"]),
    ),
    Recipe(
        "A run option",
        {"PLACE": "loop"},
        {
            "nsmodel/simulation/options.py": {
                "\n    def __post_init__(self)": OPTION,
                'The options of `simulate`: all."""\n': 'The options of `simulate`: all."""\n\n    remark: str\n',
            },
            "nsmodel/simulation/PLACE.py": {
                '"save_every": self.options.save_every,': '"save_every": self.options.save_every, "remark": self.options.remark,'
            },
            "tests/simulation/test_options.py": {'"run": "step': '"run": "remark step'},
            "docs/guide.md": {'| `solver="auto"` |': '| `remark=` | `--remark TEXT` | a text |\n| `solver="auto"` |'},
        },
        frozenset(),
        (OPTION_TEST, ["tests/simulation/test_options.py"]),
    ),
    Recipe(
        "A block with memory",
        {},
        {
            "nsmodel/modeling/standard_blocks.py": {
                "def dead_time(": BLOCK.lstrip(),
                '"latch", "pid",': '"latch", "peak_hold", "pid",',
            },
            "nsmodel/__init__.py": {"latch, pid,": "latch, peak_hold, pid,", '    "pid",\n': '    "peak_hold",\n    "pid",\n'},
            "docs/inputs.md": {"| `latch(q,": "| `peak_hold(w, y, start=)` | w = max y so far |\n| `latch(q,"},
            "docs/api/inputs.md": {".. autofunction:: latch": ".. autofunction:: latch\n.. autofunction:: peak_hold"},
        },
        frozenset(),
        (BLOCK_TEST, ["tests/package/test_package.py", "-k", "held or exported or (documented and peak_hold) or sorted"]),
    ),
]  # fmt: skip


@pytest.mark.parametrize("page", ["architecture.md", "decisions.md", "residuals.md"])
def test_paths_of_a_page_are_there(page):
    """Paths are from the repository, the package or one of its folders on; names in capitals stand for any."""
    text = (REPOSITORY / "docs" / page).read_text(encoding="utf-8")
    paths = {path for path in re.findall(r"`([\w./*]+/[\w./*]*)`", text) if not re.search(r"NAME|CLASS|PLACE", path)}
    package = REPOSITORY / "nsmodel"
    found = {path for path in paths if [*REPOSITORY.glob(path), *package.glob(path), *package.glob(f"*/{path}")]}
    assert found == paths


def places_in_document(heading: str) -> list[str]:
    """Return the files that a recipe of docs/architecture.md names, one at the beginning of each of its lines."""
    text = (REPOSITORY / "docs" / "architecture.md").read_text()
    found = re.search(rf"^### {heading}\n(.*?)(?=^#|\Z)", text, re.MULTILINE | re.DOTALL)
    assert found, f"docs/architecture.md has no recipe '{heading}'"
    return re.findall(r"^- `([^`]+)`", found[1], re.MULTILINE)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler")
@pytest.mark.parametrize("recipe", RECIPES, ids=lambda recipe: recipe.heading)
def test_a_recipe_gives_what_it_promises(recipe, tmp_path, quick_programs):
    assert set(places_in_document(recipe.heading)) == set(recipe.added) | recipe.optional
    for part in PARTS:
        source = REPOSITORY / part
        if source.is_dir():
            shutil.copytree(source, tmp_path / part, ignore=NOT_COPIED)
        else:
            shutil.copy(source, tmp_path)
    for place, change in recipe.added.items():
        for word, name in recipe.names.items():
            place = place.replace(word, name)
        path = tmp_path / place
        if isinstance(change, str):
            assert not path.exists()
            path.write_text(change.lstrip(), encoding="utf-8")
            continue
        text = path.read_text(encoding="utf-8")
        for old, new in change.items():
            assert text.count(old) == 1, f"{place} has {text.count(old)} times {old!r}"
            text = text.replace(old, new)
        path.write_text(text, encoding="utf-8")
    own, arguments = recipe.tests
    (tmp_path / "tests" / "test_recipe.py").write_text(own, encoding="utf-8")
    environment = os.environ | {"PYTHONPATH": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path / "cache")} | quick_programs
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-n", "0", "tests/test_recipe.py", *arguments]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-2000:]
