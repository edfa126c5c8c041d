"""Certificates of many bodies: those of the sweeping process that they are, written out."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from nsmodel.certificate.data import Subject
from nsmodel.certificate.hints import Unproved
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.sweeping import certificate as sweeping
from nsmodel.hypotheses.findings import Finding

MOST_CONSTRAINTS = 400  # Families of more are not written out.
STATED = sweeping.STATED


def subject(model: ManyBodies, findings: Mapping[str, Finding]) -> Subject:
    """The sweeping process as data."""
    if sum(family.count for family in model.constraints.values()) > MOST_CONSTRAINTS:
        raise Unproved(f"more than {MOST_CONSTRAINTS} constraints of families")
    if not isinstance(model.f, ca.SX):
        raise Unproved("a velocity that is a function of numbers")
    return sweeping.subject(model.written_out(), findings)
