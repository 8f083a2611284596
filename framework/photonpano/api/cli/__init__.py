"""The command line: it reads arguments, calls functions of `api`, and prints their results."""

from photonpano.api.cli.app import main

__all__ = ["main"]
