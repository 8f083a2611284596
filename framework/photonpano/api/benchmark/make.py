"""Write the captures of the benchmark."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import typer

from photonpano import __version__
from photonpano.api.benchmark.captures import (
    ALL,
    DESCRIPTION,
    PUBLIC,
    SEALED,
    VERSION,
    Benchmark,
    capture_plan,
    described_capture,
)
from photonpano.api.command import command
from photonpano.api.simulate import simulate
from photonpano.errors import InputError
from photonpano.execution.context import Progress, Quiet, usual
from photonpano.files.folders import atomic_folder, require_new
from photonpano.reading import reading

_SHORTEST = 16  # bytes of a secret that nobody guesses


def _lines(made: Benchmark) -> Iterator[str]:
    for name, capture in made.captures.items():
        height, width = capture.frame_shape
        yield f"{name:26}{capture.n_frames:,} frames of {height}x{width}"


@command(
    "set --captures flat --captures dark",
    _lines,
    folder=typer.Argument(metavar="DIR", help="The folder of the set."),
    captures=typer.Option(metavar="NAME"),
    secret=typer.Option(metavar="FILE"),
    truths=typer.Option(metavar="DIR"),
)
def make(
    folder: Path | str,
    captures: Sequence[str] = (),
    secret: Path | str | None = None,
    truths: Path | str | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Benchmark:
    """Write the captures of the benchmark with their truth, and benchmark.json, which describes them.

    The sealed captures come with a release. Who keeps their secret makes them with it; their truth goes to another folder.

    Args:
        folder: of the set.
        captures: names of the captures to write; by default all that can be.
        secret: a file of 16 bytes or more, from which the sealed captures are drawn.
        truths: the folder for the truth of the sealed captures.
        overwrite: replace the captures that are there under these names.
        progress: receives the stages; by default, bars in a notebook and nothing elsewhere.

    Raises:
        InputError: there is no such capture, or the secret is missing or too short.
        OutputError: the folder, or a truth of a sealed capture, is there already, or cannot be written.
    """
    folder = Path(folder)
    chosen = captures or (PUBLIC if secret is None else ALL)
    if unknown := sorted(set(chosen) - set(ALL)):
        raise InputError(f"there is no capture {' or '.join(unknown)}; choose from {', '.join(ALL)}")
    sealed = [name for name in chosen if name.startswith(SEALED)]
    if sealed and (secret is None or truths is None):
        raise InputError(
            f"{', '.join(sealed)}: sealed captures come with a release; to make them, give their --secret, and a folder for "
            "their --truths"
        )
    seed = None if secret is None else _secret(Path(secret))
    require_new(folder, overwrite)
    sealed_truths = {name: Path(truths, f"{name}.truth.npz") for name in sealed} if truths is not None else {}
    for path in sealed_truths.values():
        require_new(path, overwrite)
    described = {}
    with atomic_folder(folder) as written, usual(progress).stage("benchmark", len(chosen), "captures") as advance:
        for name in chosen:
            plan = capture_plan(name, seed)
            made = simulate(plan, written / f"{name}.npy", Quiet())
            if name in sealed_truths:
                assert made.truth is not None
                sealed_truths[name].parent.mkdir(parents=True, exist_ok=True)
                shutil.move(made.truth, sealed_truths[name])
            described[name] = described_capture(made.path, plan)
            advance(1)
        benchmark = Benchmark(version=VERSION, photonpano=__version__, captures=described)
        (written / DESCRIPTION).write_text(benchmark.model_dump_json(indent=2) + "\n", encoding="utf-8")
    return benchmark


def _secret(path: Path) -> bytes:
    with reading(path):
        secret = path.read_bytes().strip()
    if len(secret) < _SHORTEST:
        raise InputError(f"{path} holds {len(secret)} bytes, which can be guessed; give a secret of {_SHORTEST} bytes or more")
    return secret
