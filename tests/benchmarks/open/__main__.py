"""The command line of the open benchmark, from the root of the repository: python -m tests.benchmarks.open --help."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from photonpano.api.cli.progress import progress_for_stderr
from photonpano.errors import PhotonpanoError
from photonpano.text import columns

from .captures import make
from .score import HEADER, score


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.benchmarks.open", description="Make the captures, or score an entry."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    makes = commands.add_parser("make", help="write the captures with their truth, and benchmark.json, which describes them")
    makes.add_argument("folder", metavar="DIR", type=Path, help="the folder of the set")
    makes.add_argument("--captures", metavar="NAME", action="append", default=[], help="a capture to write; by default all")
    makes.add_argument("--secret", metavar="FILE", type=Path, help="16 bytes or more, from which sealed captures are drawn")
    makes.add_argument("--truths", metavar="DIR", type=Path, help="the folder for the truth of sealed captures")
    makes.add_argument("--overwrite", action="store_true", help="replace a set that is there")
    scores = commands.add_parser("score", help="score the motion or the panoramas that any program has made of the captures")
    scores.add_argument("folder", metavar="DIR", type=Path, help="the folder that `make` wrote")
    scores.add_argument("entry", metavar="ENTRY", type=Path, help="a folder with a file or a run folder for each capture")
    scores.add_argument("--truths", metavar="DIR", type=Path, help="the folder of the truth of sealed captures")
    scores.add_argument("--json", action="store_true", help="print JSON, for programs")
    return parser


def _lines(given: argparse.Namespace) -> Iterator[str]:
    progress = progress_for_stderr()
    if given.command == "make":
        made = make(given.folder, given.captures, given.secret, given.truths, overwrite=given.overwrite, progress=progress)
        for name, capture in made.captures.items():
            height, width = capture.frame_shape
            yield f"{name:26}{capture.n_frames:,} frames of {height}x{width}"
        return
    scores = score(given.folder, given.entry, given.truths, progress=progress)
    if given.json:
        yield json.dumps([asdict(each) for each in scores], indent=2)
    else:
        yield columns([HEADER, *(each.cells() for each in scores)])


def main() -> None:
    """Run the command, and exit with 1 after a message if what it is given is wrong."""
    try:
        for line in _lines(_parser().parse_args()):
            print(line)
    except PhotonpanoError as error:
        sys.exit(f"error: {error}")


if __name__ == "__main__":
    main()
