"""The version of this code, also where another copy is installed."""

VERSION = "0.3.0"
