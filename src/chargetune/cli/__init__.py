"""The command line: parse, call, print."""

from chargetune.cli.app import main

__all__ = ["main"]
