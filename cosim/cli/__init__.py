"""The command line: what `cosim` takes and prints; the work is done elsewhere."""

from __future__ import annotations

from cosim.cli.process import command, main

__all__ = ["command", "main"]
