"""``python -m nsmodel``."""

import sys

from nsmodel.cli import main

if __name__ == "__main__":
    sys.exit(main())
