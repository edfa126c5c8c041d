"""Certificates of many bodies: those of the sweeping process that they are, written out."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca

from nsmodel.certificate.data import CertificateSubject
from nsmodel.certificate.hints import UnprovedFinding
from nsmodel.classes.bodies.model import ManyBodies
from nsmodel.classes.sweeping import certificate as sweeping
from nsmodel.hypotheses.findings import Finding

MAX_WRITTEN_CONSTRAINTS = 400  # Families of more are not written out.
STATED = sweeping.STATED


def subject(model: ManyBodies, findings: Mapping[str, Finding]) -> CertificateSubject:
    """The sweeping process as data."""
    if sum(family.count for family in model.constraints.values()) > MAX_WRITTEN_CONSTRAINTS:
        raise UnprovedFinding(f"more than {MAX_WRITTEN_CONSTRAINTS} constraints of families")
    if not isinstance(model.f, ca.SX):
        raise UnprovedFinding("a velocity that is a function of numbers")
    return sweeping.subject(model.written_out(), findings)
