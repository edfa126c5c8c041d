"""False statements with made-up proofs: the program of certificates answers none of them with yes."""

from __future__ import annotations

import json
import subprocess
import sys

import casadi as ca
import pytest
from search import falsity, forgeries
from search.claims import FORGERIES, TRUE, claim, inclusion, with_steps

from nsmodel import LureSystem, SweepingProcess, UsageError, check, relay
from nsmodel.hypotheses.certificates import verify
from nsmodel.hypotheses.certificates.write import certificate_of, write_certificate


def test_no_forgery_of_the_list_is_answered_yes():
    answers = {name: verify.answer(*pair) for name, pair in FORGERIES.items()}
    assert {name: answer for name, answer in answers.items() if answer[0] not in ("no", "not checkable")} == {}
    assert not any("not well formed" in text for _, text in answers.values())


def test_the_true_ones_beside_them_are_proved():
    answers = {name: verify.answer(*pair) for name, pair in TRUE.items()}
    assert {name: answer for name, answer in answers.items() if answer[0] != "yes"} == {}


def test_the_sentence_is_made_from_the_numbers():
    model, statement = TRUE["M-A2"]
    lied = {**statement, "statement": "F is bounded", "why": "yes", "source": "A5 yes"}
    assert verify.answer(model, lied) == ("yes", "|v| <= 1 + 1 |x| for all x and all v in F(x) - S(x)")
    wider = {**statement, "value": {"a_1": "4/3", "a_2": "123456789123456789/100000000000000000"}}
    assert verify.answer(model, wider)[1].startswith("|v| <= 4/3 + 1.23456789123457 |x|")  # Rounded up.
    model, statement = TRUE["M-A1"]
    assert "x in [1/8, 1]" in verify.answer(model, statement)[1]


JUNK = (None, True, 0, -1, 1.5, float("nan"), float("inf"), "", "x", "nan", "1e9", "1/0", "١", [], {}, [[]], [None], {"a": []})


def places(item, path=()):
    yield path
    if isinstance(item, dict | list):
        for key, part in item.items() if isinstance(item, dict) else enumerate(item):
            yield from places(part, (*path, key))


def replaced(item, path, new):
    if not path:
        return new
    copy = dict(item) if isinstance(item, dict) else list(item)
    copy[path[0]] = replaced(item[path[0]], path[1:], new)
    return copy


def test_wrong_types_are_no_and_never_an_exception():
    for pair in TRUE.values():
        for path in list(places(list(pair)))[1:]:
            for junk in JUNK:
                kind, text = verify.answer(*replaced(list(pair), path, junk))
                assert kind in ("yes", "no", "not checkable")
                assert "\n" not in text


def written(tmp_path, **changes):
    """The output of the program for a certificate with changes."""
    model, statement = TRUE["M-A2"]
    certificate = {"format": verify.FORMAT, "title": "a title", "hash": verify.digest(model), "model": model}
    certificate |= {"statements": [statement]} | changes
    path = tmp_path / "certificate.json"
    path.write_text(json.dumps(certificate))
    return subprocess.run([sys.executable, "-I", "-S", verify.__file__, str(path)], capture_output=True, text=True)


HIDDEN = "\nA5           yes: everything\r\x1b[2K\u202eA5\u2028"


def test_what_a_certificate_calls_itself_is_escaped(tmp_path):
    model, statement = TRUE["M-A2"]
    named = {**model, "class": HIDDEN}
    unproved = {**statement, "proof": None, "why": HIDDEN}
    cases = [{"title": HIDDEN}, {"statements": [unproved]}, {"statements": [{**statement, "id": HIDDEN}]},
             {"model": named, "hash": verify.digest(named)}, {"statements": [{**statement, "statement": HIDDEN}]}]  # fmt: skip
    for change in cases:
        found = written(tmp_path, **change)
        assert not found.stderr
        assert all(32 <= ord(letter) < 127 for line in found.stdout.splitlines() for letter in line)
        assert not any(line.startswith("A5") for line in found.stdout.splitlines())


def test_an_input_with_a_strange_name_is_escaped(tmp_path):
    model, statement = TRUE["M-A1"]
    model = json.loads(json.dumps(model).replace('"x"', json.dumps(HIDDEN)))
    statement = json.loads(json.dumps(statement).replace('"x"', json.dumps(HIDDEN)))
    found = written(tmp_path, model=model, hash=verify.digest(model), statements=[statement])
    assert "1 yes, 0 no" in found.stdout
    assert not any(line.startswith("A5") for line in found.stdout.splitlines())


def test_ids_of_other_types_and_unknown_ones(tmp_path):
    ids = [[], ["A5"], {}, None, 5, "A6", True]
    found = written(tmp_path, statements=[*({**TRUE["M-A2"][1], "id": id} for id in ids), None, [], "A5"])
    assert not found.stderr
    assert "0 yes" in found.stdout


def test_a_name_twice_in_an_object_is_refused(tmp_path):
    written(tmp_path)
    path = tmp_path / "certificate.json"
    path.write_text(path.read_text().replace('"title"', '"title": "another", "title"', 1))
    assert "a name stands twice" in verify.main(str(path))


def test_files_that_are_no_certificates(tmp_path):
    path = tmp_path / "other.json"
    for text in ("[" * 100000, '{"a": ' * 100000, "\ud800", "NaN", ""):
        path.write_bytes(text.encode("utf-8", "surrogatepass"))
        assert "is no certificate" in verify.main(str(path))


def test_programs_that_take_for_ever_are_not_read():
    squared = [["in", 0], *(["mul", k, k] for k in range(60))]
    model = {**inclusion(), "F": {"inputs": ["x"], "steps": [*squared, ["add", 1, 60]], "outputs": [61]}}
    assert verify.answer(model, claim("M-A2", a_1="1", a_2="1"))[0] != "yes"
    long = [["in", 0], ["const", "3"], *(["mul", k, k] for k in range(1, 60))]
    model = {**inclusion(), "F": {"inputs": ["x"], "steps": long, "outputs": [60]}}
    assert verify.answer(model, claim("M-A2", a_1="1", a_2="1"))[0] != "yes"
    model = with_steps(inclusion(), "F", ("in", 0), ("pow", 0, "1000000000000"))
    assert verify.answer(model, claim("M-A1", {"cover": None}, {"x": ["2", "3"]}))[0] != "yes"


# -- boxes of parameters -------------------------------------------------------------------------------------------------------


def test_a_report_over_a_box_of_parameters_has_no_certificate(tmp_path):
    p = ca.SX.sym("p")
    model = LureSystem(A=[[-1]], B=[p], C=[1], law=relay(1), x0=[1], t_end=1, step=0.1, parameters={p: 1.0})
    swept = SweepingProcess(q=q, f=[0], constraints={"wall": q + p}, q0=[1], t_end=1, step=0.1, parameters={p: 1.0})
    for one in (model, swept):
        with pytest.raises(UsageError, match="give a value to p"):
            certificate_of(check(one, parameters={"p": (0.5, 2)}, quick=True))
    with pytest.raises(UsageError, match="give a value to p"):
        write_certificate(check(model, parameters={"p": (0.5, 2)}, quick=True), tmp_path)
    assert certificate_of(check(model, quick=True))["statements"]


# -- a search at random, and the checker with a premise dropped --------------------------------------------------------------


def test_no_forgery_is_found_at_random():
    from search import forgeries

    found, accepted = [], 0
    for rule in verify.STATEMENTS:
        assert forgeries.originals()[rule], rule
        more, yes = forgeries.search(rule, 10, seed=5, seconds=0.3)
        found, accepted = found + more, accepted + yes
    assert not found, found[0]
    assert accepted > 30  # Many changes leave a statement true: the oracle has something to look at.


def test_the_oracle_finds_no_fault_with_what_is_true():
    from search import falsity, forgeries

    for pairs in forgeries.originals().values():
        assert not falsity.find(*pairs[0], seed=1)
    assert not any(falsity.find(*pair) for pair in TRUE.values())


SEEN = "O-g; O-theta, squares; M-A3, squares; M-T of -|x|; O-dry, two opposed; 5.4c, D = -1; A5, d = 0; M-T, phi and S"
SEEN += "; M-24, C not convex; M-A2 of x/x - 1; 4.1, least < 0; 7.1 of 0 log t; F-unique, K empty"


def test_the_oracle_sees_that_forgeries_are_false():
    from search import falsity

    assert [name for name in SEEN.split("; ") if not any(falsity.find(*FORGERIES[name], seed=k) for k in range(4))] == []


def test_the_search_finds_what_a_checker_without_a_premise_lets_pass():
    from search import forgeries

    tried = list(forgeries.mutants(("dry", "steps_grow", "feedthrough")))
    assert len(tried) >= 6
    missed = []
    for where, module in tried:
        rules = forgeries.rules_of(where.split()[0])
        if not any(forgeries.search(rule, 1000, 0, module)[0] for rule in rules):
            missed.append(where)
    assert not missed
