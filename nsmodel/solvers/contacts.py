"""The contacts of many bodies: what acted in a step."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nsmodel._utils import short_repr


class Contacts(NamedTuple):
    """Constraints with a reaction > 0: arrays (K,) of the family's number, the members (second: body or item, -1 none), m/h."""

    family: np.ndarray
    first: np.ndarray
    second: np.ndarray
    reaction: np.ndarray

    __repr__ = short_repr


def sort_contacts(contacts: Contacts) -> Contacts:
    """The contacts sorted by family, first and second member."""
    order = np.lexsort((contacts.second, contacts.first, contacts.family))
    return Contacts(*(part[order] for part in contacts))


NO_CONTACTS = Contacts(np.zeros(0, np.int8), np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0))
