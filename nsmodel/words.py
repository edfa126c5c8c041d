"""Text of the user's as it may be shown: titles and names may carry what moves a cursor or turns the direction of reading."""

from __future__ import annotations

import builtins
import re
from typing import Any

# Control characters, ends of lines, marks of direction, characters of no width (but the joiners that scripts need).
INVISIBLE_CHARACTERS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u2069\ufeff]")


def one_line(text: str) -> str:
    """The text with a blank for each character that is not seen.

    >>> one_line("a" + chr(27) + "[31m" + chr(0x202E) + "b")
    'a [31m b'
    """
    return INVISIBLE_CHARACTERS.sub(" ", text)


def escape_invisible(text: str) -> str:
    r"""The text with an escape for each character that is not seen; lines and tabs stay.

    >>> escape_invisible("a" + chr(27) + "[31m" + chr(0x202E) + "b")
    'a\\x1b[31m\\u202eb'
    """
    return INVISIBLE_CHARACTERS.sub(
        lambda match: match[0] if match[0] in "\n\t" else match[0].encode("unicode_escape").decode(), text
    )


def print_escaped(*parts: Any, **options: Any) -> None:
    """``print``, of what may be shown."""
    builtins.print(*(escape_invisible(str(part)) for part in parts), **options)
