"""Standard output: a document of its own with --json."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Iterator
from typing import Any

from nsmodel._utils import print_escaped as print
from nsmodel.files.storage import dumps


@contextlib.contextmanager
def reserve_stdout(arguments: argparse.Namespace) -> Iterator[None]:
    """Keep standard output for the document of --json: what a model file prints meanwhile goes to standard error."""
    arguments.stdout = sys.stdout
    with contextlib.redirect_stdout(sys.stderr if getattr(arguments, "json", False) else sys.stdout):
        yield


def print_json(arguments: argparse.Namespace, document: Any) -> None:
    """Print what --json asks for."""
    print(dumps(document, indent=2), file=arguments.stdout)
