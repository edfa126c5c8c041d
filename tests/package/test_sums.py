"""Answers do not depend on the Python: its ``sum`` of floats is compensated from 3.12 on."""

import json
import random
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import answers
import pytest
from fuzz_models import COUNT, FULL
from processes import environment

from nsmodel._utils import sum_in_order

PROGRAM = Path(answers.__file__)
CASES = answers.CASES if COUNT == FULL else answers.CASES[:3]
LIBRARIES = ("casadi", "numpy", "scipy")  # Of one version, as these have bits of their own.


def run(python: str, *arguments: str) -> dict:
    """What the program prints."""
    whole = environment(OPENBLAS_NUM_THREADS="1", PYTHONDONTWRITEBYTECODE="1")
    out = subprocess.run([python, str(PROGRAM), *arguments, *CASES], env=whole, capture_output=True, text=True, check=False)
    assert out.returncode == 0, out.stderr
    return json.loads(out.stdout)


@pytest.fixture(scope="module")
def own_answers():
    """Those of this Python."""
    return run(sys.executable)["answers"]


def test_no_answer_depends_on_how_sum_adds_floats(own_answers):
    found = run(sys.executable, "--compensated")
    assert len(own_answers) == 3 * len(CASES) - len(answers.WITHOUT_EVENTS)
    assert found["answers"] == own_answers
    assert found["callers"] == []


@pytest.mark.parametrize("name", ["python3.12", "python3.13", "python3.14"])
def test_other_pythons_have_the_same_bits(own_answers, name):
    python = shutil.which(name)
    asked = f"from importlib.metadata import version; print(*map(version, {LIBRARIES}))"
    known = subprocess.run([python, "-c", asked], capture_output=True, text=True, check=False).stdout if python else ""
    if known.split() != [*map(version, LIBRARIES)]:
        pytest.skip(f"{name} is not here, with {', '.join(LIBRARIES)} of the versions of this Python")
    assert run(python)["answers"] == own_answers


def test_sum_in_order_rounds_each_addition():
    assert answers.compensated_sum([0.1] * 10) == 1.0
    assert sum_in_order([0.1] * 10) == 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 + 0.1 == 1 - 2**-53
    assert sum_in_order(iter([2, 3]), 1) == 6
    assert sum_in_order([]) == 0


@pytest.mark.skipif(sys.version_info < (3, 12), reason="sum adds in order")
def test_compensated_sum_is_that_of_this_python():
    draw = random.Random(0)
    for size in range(1000):
        numbers = [draw.gauss(0, 1) * 10.0 ** draw.randint(-20, 20) for _ in range(size % 10)]
        assert answers.compensated_sum(numbers) == sum(numbers)
