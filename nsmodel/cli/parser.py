"""The parser of the command line: what is misspelt is answered by what is near, beside the usage of the command itself."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Sequence
from typing import Any, NoReturn

CHOICE_PATTERN = re.compile(r"invalid choice: '(.*?)' \(choose from")


class CommandParser(argparse.ArgumentParser):
    """A parser of all its arguments; those of its commands are such parsers too."""

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> tuple[Any, list[str]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Refuse here what the command does not take: its own usage is shown, and not that of all."""
        found, left = super().parse_known_args(args, namespace)
        if left:
            names = [one.partition("=")[0] for one in left if one.startswith("-")]
            self.error(f"unrecognized arguments: {' '.join(left)}{_suggestion(names, self._option_string_actions)}")
        return found, left

    def error(self, message: str) -> NoReturn:
        """Say what is near to a word that is none of those there are."""
        choices = [str(one) for action in self._actions for one in action.choices or ()]
        super().error(message + _suggestion(CHOICE_PATTERN.findall(message), choices))


def _suggestion(tokens: Sequence[str], known: Any) -> str:
    found = [near[0] for word in tokens if (near := difflib.get_close_matches(word, list(known), 1))]
    return f"; did you mean {' '.join(found)}?" if found else ""
