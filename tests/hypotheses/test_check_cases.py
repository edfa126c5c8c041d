"""Every case file against its hypotheses: what must be proved, what is known to fail, what may stay open and why."""

from __future__ import annotations

import pkgutil
import re
from importlib import import_module

import casadi as ca
import numpy as np
import pytest
from conftest import CASES, REPOSITORY
from search.golden import BOUNDS

import nsmodel
from nsmodel.hypotheses import along_run
from nsmodel.hypotheses.check import hypotheses_of
from nsmodel.hypotheses.findings import VERDICTS, Hypothesis
from nsmodel.hypotheses.framework import HYPOTHESIS_CHECKS
from nsmodel.modeling.parts import MODEL_CLASSES

# The hypotheses of each case that must be proved. "sampled" where a proof exists is a defect.
HOLDS = {
    "anti_windup": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "arch": "S-convex A0 A1 A2 A3 A4 S-start",
    "ball_on_ramp": "C-M C-lin C-start C-e C-theta",
    "hook_ball": "C-M C-lin C-start C-e C-theta",
    "slider_crank": "C-M C-lin C-start C-theta",
    "woodpecker": "C-M C-lin C-start C-theta",
    "bang_bang": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "belt": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "boost": "F-jacobians F-W F-step",
    "bouncing_ball": "C-M C-lin C-start C-e C-theta",
    "bowling_ball": "C-M C-lin C-start C-e C-theta",
    "buck": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c",
    "buck_light_load": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c",
    "cabot_4_1": "O-theta O-g O-dry O-steps",
    "cabot_4_2": "O-theta O-g O-dry O-steps",
    "cabot_4_3": "O-theta O-g O-dry O-steps",
    "city_blocks": "S-convex A0 A1 A2 A3 A4 S-start",
    "counterflow": "S-convex A0 A1 A2 A3 A4 S-start",
    "crossing": "S-convex A0 A1 A2 A3 A4 S-start",
    "crowd": "S-convex A0 A1 A2 A3 A4 S-start",
    "crowd_room": "S-convex A0 A1 A2 A3 A4 S-start",
    "diode_bridge": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0 7.1",
    "drive_cycle": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "elastoplastic": "M-T M-C M-A1 M-A2 M-A3 M-24 M-H",
    "evacuation": "S-convex A0 A1 A2 A3 A4 S-start",
    "friction_chain": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "friction_fit": "O-theta O-g O-dry O-steps",
    "friction_oscillator": "O-theta O-g O-dry O-steps",
    "friction_oscillator_relay": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0 7.1",
    "full_wave_rectifier": "F-jacobians F-W F-mlcp F-unique F-step",
    "gene_network": "F-jacobians F-W F-step",
    "half_wave_rectifier": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c",
    "inclusion_8_1": "M-T M-C M-A1 M-A2 M-A3 M-24",
    "inclusion_8_2": "M-T M-C M-A1 M-A2 M-A3 M-24",
    "inclusion_8_2_full": "M-T M-C M-A1 M-A2 M-A3 M-24",
    "integrate_and_fire": "F-jacobians F-W F-mlcp F-unique F-step",
    "leash": "M-T M-C M-A1 M-A2 M-A3 M-24 M-H",
    "moving_disc": "S-convex A0 A1 A2 A3 A4 A5 A5' S-f S-start",
    "moving_half_line": "S-convex A0 A1 A2 A3 A4 A5 A5' S-f S-start",
    "observer": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "obstacle": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "point_past_disc": "S-convex A0 A1 A2 A3 A4 A5 A5' S-f S-start",
    "relay_oscillator": "3.1 4.1 5.4a 5.4b 5.4c 5.x0 7.1",
    "repressilator": "F-jacobians F-W F-step",
    "rlc_diode": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0 7.1",
    "rocking_block": "C-M C-lin C-start C-e C-theta",
    "running_track": "S-convex A0 A1 A2 A3 A4 S-start",
    "sampled_pi": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "sandpile": "S-convex A0 A1 A2 A3 A4 S-f S-start",
    "schmitt_trigger": "F-jacobians F-W F-mlcp F-unique F-step",
    "sliding_mode": "F-jacobians F-W F-mlcp F-unique F-step",
    "sliding_relay": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "stairs": "S-convex A0 A1 A2 A3 A4 S-start",
    "thermostat": "F-jacobians F-W F-mlcp F-unique F-step",
    "three_pulse_rectifier": "F-jacobians F-W F-mlcp F-unique F-step",
    "thyristor": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c",
    "toggle_switch": "F-jacobians F-W F-step",
    "total_variation": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0 7.1",
    "tumbler": "S-convex A0 A1 A2 A3 A4 A5 A5' S-f",
    "twisting": "3.1 4.1 5.4a 5.4b 5.4c 5.x0 7.1",
    "two_discs": "S-convex A0 A1 A2 A3 A4 A5 A5' S-f S-start",
    "two_masses": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "two_surfaces": "3.1 4.1 5.1 5.2 5.4a 5.4b 5.4c 5.x0",
    "voltage_doubler": "F-jacobians F-W F-mlcp F-unique F-step",
    "zener_limiter": "M-T M-C M-A1 M-A2 M-A3 M-24 M-H",
    "zhuravlev_ivanov": "F-jacobians F-W F-step",
}
# What really fails, and why: a report without these would be wrong.
VIOLATED = {
    "anti_windup": {"7.1": "it is forced"},
    "bang_bang": {"7.1": "it is forced"},
    "belt": {"7.1": "it is forced"},
    "boost": {"F-mlcp": "an input multiplies the multipliers: W_mlcp is indefinite", "F-inputs": "h jumps at an edge"},
    "buck": {"5.x0": "the current begins at 0, on the boundary of the set", "7.1": "it is forced"},
    "buck_light_load": {"5.x0": "the current begins at 0, on the boundary of the set", "7.1": "it is forced"},
    "crowd": {"S-f": "the desired velocity jumps where a body crosses the door's line beside the opening"},
    "crowd_room": {"S-f": "the desired velocity jumps where a body crosses the door's line beside the opening"},
    "drive_cycle": {"7.1": "it is forced"},
    "friction_chain": {"7.1": "it is forced"},
    "slider_crank": {"C-e": "e = 0.4 where there is friction"},
    "woodpecker": {"C-e": "e = 1/2 at the beak alone"},
    "gene_network": {"F-mlcp": "the multipliers enter as a product: W_mlcp is indefinite"},
    "half_wave_rectifier": {"5.x0": "the current begins at 0, on the boundary of the set", "7.1": "it is forced"},
    "observer": {"7.1": "it is forced"},
    "obstacle": {"7.1": "it is forced"},
    "relay_oscillator": {"5.1": "C B = 0"},
    "repressilator": {"F-mlcp": "the ring is not monotone"},
    "sampled_pi": {"7.1": "it is forced"},
    "sliding_relay": {"7.1": "it is forced"},
    "thyristor": {"5.x0": "the current begins at 0, on the boundary of the set", "7.1": "it is forced"},
    "toggle_switch": {"F-mlcp": "it has two rests"},
    "twisting": {"5.1": "the relay on p does not act on p'"},
    "two_masses": {"7.1": "it is forced"},
    "two_surfaces": {"7.1": "it is forced"},
    "zhuravlev_ivanov": {"F-mlcp": "the multipliers enter as a product: W_mlcp is indefinite"},
}
NOT_DECIDED = dict.fromkeys("C-ind C-mfcq C-W C-P C-F".split(), "not decided yet")
# What is not decided, and the reason that the report gives.
UNKNOWN = {
    **dict.fromkeys("ball_on_ramp bouncing_ball bowling_ball hook_ball rocking_block".split(), NOT_DECIDED),
    **dict.fromkeys(("slider_crank", "woodpecker"), NOT_DECIDED),
    "boost": {"F-unique": "index sets are not enumerated"},
    "relay_oscillator": {"5.2": "no P > 0 with P B = C' exists"},
    "toggle_switch": {"F-unique": "index sets"},
    "twisting": {"5.2": "no P > 0 with P B = C' exists"},
}


@pytest.fixture(scope="module")
def report_of(load_case, run_case):
    """Return report_of(stem), each made once from the case's own run."""
    reports = {}

    def report(stem):
        if stem not in reports:
            reports[stem] = nsmodel.check(load_case(stem), [run_case(stem)], bounds=BOUNDS.get(stem))
        return reports[stem]

    return report


def test_every_case_is_listed():
    assert sorted(HOLDS) == [path.stem for path in CASES]


def test_a_case_has_each_hypothesis_once_and_those_that_must_be_proved_are(case_file, load_case, report_of):
    stem = case_file.stem
    report = report_of(stem)
    asked = [hypothesis.id for hypothesis in hypotheses_of(type(load_case(stem)))]
    ids = [finding.id for finding in report.findings]
    assert ids[: len(asked)] == asked
    assert len(set(ids)) == len(ids)
    assert {id: report[id].verdict for id in HOLDS[stem].split()} == dict.fromkeys(HOLDS[stem].split(), "holds")
    for verdict, known in (("violated", VIOLATED), ("unknown", UNKNOWN)):
        assert {finding.id for finding in report.having(verdict)} == set(known.get(stem, {}))
    for id, reason in UNKNOWN.get(stem, {}).items():
        assert reason in report[id].how


@pytest.mark.long
def test_the_crowd_in_a_room(load_case, report_of):
    """Its numbers are those of the people and the walls, for all states; in the doorway the wish of the slim jumps."""
    model, found = load_case("crowd_room"), report_of("crowd_room")
    assert {found[id].scope for id in ("S-convex", "A0", "A1", "A2", "A3", "A4")} == {None}
    radii = np.asarray(model.scene["radii"])
    assert (found["A1"].value["a"], found["A1"].value["b"]) == pytest.approx((1, np.sqrt(2)))
    assert found["A4"].value["M_contact"] == pytest.approx(1 / radii.min())
    assert found["A0"].value["c"] == pytest.approx(radii.min() / 2)
    assert found["A5'"].verdict == found["A5"].verdict == "sampled"
    assert 1 < found["A5'"].value["gamma"] <= found["A5"].value["gamma"] < np.inf
    witness = found["S-f"].witness
    state, moved = np.array(witness["q"]), [model.names.index(name) for name in witness["moved"]]
    assert state[moved].tolist() == witness["to"]
    assert np.array(ca.Function("g", [model.t, model.q], [model.g])(witness["t"], state)).min() >= -1e-12
    f = ca.Function("f", [model.t, model.q], [model.f])
    across = []
    for side in (-1e-9, 1e-9):
        beside = state.copy()
        beside[moved[0]] = 3.6 + side  # the door's wall
        across.append(np.linalg.norm(np.array(f(0, state) - f(0, beside))))
    assert max(across) == pytest.approx(witness["size"], rel=1e-5)


def test_findings_of_a_case_carry_numbers_reasons_and_sources(case_file, report_of):
    for finding in report_of(case_file.stem).findings:
        assert finding.verdict in VERDICTS
        assert finding.statement
        assert finding.how
        assert finding.source
        assert finding.value or finding.verdict == "unknown" or finding.id in ("3.1", "5.x0")  # which nothing need limit
        assert all(np.isfinite(number) for number in finding.value.values()) or finding.verdict != "holds"
        if finding.verdict == "violated":
            assert finding.witness


def test_a_quick_check_never_says_more_than_a_full_one(case_file, quick_check, report_of):
    """What is proved quickly is proved; what fails quickly fails."""
    full = report_of(case_file.stem)
    quick = quick_check(case_file.stem)
    assert "quick" in quick.verdict
    for finding in quick.findings:
        if finding.verdict in ("holds", "violated"):
            assert full[finding.id].verdict == finding.verdict, finding.id


def test_no_state_of_a_case_jumps(case_file, run_case, report_of):
    """The relay oscillator's relay acts late (C B = 0), but does not slide; none has a contact that does."""
    assert not [text for text in run_case(case_file.stem).metadata["warnings"] if "acts on" in text]
    assert "run-continuous" not in [finding.id for finding in report_of(case_file.stem).findings]


def test_consequences_rest_on_findings_of_the_report(case_file, report_of):
    report = report_of(case_file.stem)
    ids = {finding.id for finding in report.findings}
    assert report.consequences
    for consequence in report.consequences:
        assert set(consequence.rests_on) <= ids
        weakest = {report[id].verdict for id in consequence.rests_on}
        if consequence.verdict == "holds":
            assert weakest <= {"holds"}


def test_every_hypothesis_has_a_paragraph_in_the_docs_and_a_case():
    page = (REPOSITORY / "docs" / "hypotheses.md").read_text()
    headings = set(re.findall(r"^### (\S+)", page, flags=re.M))
    decided = {item for name in MODEL_CLASSES for item in HYPOTHESIS_CHECKS.of(getattr(nsmodel, name)).hypotheses}
    names = [module.name for module in pkgutil.walk_packages(nsmodel.__path__, "nsmodel.") if "models" in module.name]
    parts = [part for module in (along_run, *map(import_module, names)) for part in vars(module).values()]
    along = {part for part in parts if isinstance(part, Hypothesis)} - decided
    assert {"run-residual", "run-energy", "run-motion"} <= {hypothesis.id for hypothesis in along}
    assert len({hypothesis.id for hypothesis in decided}) == len(decided)
    assert {hypothesis.id for hypothesis in decided | along} <= headings
    assert all(hypothesis.statement and hypothesis.source for hypothesis in decided | along)
