"""The command line: one command a file."""

from photonpano.cli.app import main

__all__ = ["main"]
