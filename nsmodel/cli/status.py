"""What a command returns to the shell, and what it says on standard error where it stops."""

from __future__ import annotations

import errno
import os
import sys

from nsmodel._utils import print_escaped as print
from nsmodel.errors import CodegenError, ModelError, NsmodelError, StorageError

EXIT_DONE, EXIT_AT_FAULT, EXIT_USAGE, EXIT_FAILED_STEP, EXIT_REFUSED = 0, 1, 2, 3, 4


def report_refusal(error: NsmodelError) -> int:
    """Say what was refused, and return the status of that."""
    kinds = ((ModelError, "model error"), (StorageError, "storage error"), (CodegenError, "no C code"), (NsmodelError, "error"))
    print(f"nsmodel: {next(name for kind, name in kinds if isinstance(error, kind))}: {error}", file=sys.stderr)
    return EXIT_REFUSED if isinstance(error, CodegenError) else EXIT_USAGE


def close_stdout(error: OSError) -> int:
    """Give up standard output; no fault where its reader (head, less) has gone."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError) or (sys.platform == "win32" and error.errno == errno.EINVAL):
        return EXIT_DONE
    print(f"nsmodel: error: cannot write the output: {error}", file=sys.stderr)
    return EXIT_USAGE
