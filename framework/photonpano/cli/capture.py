"""What the commands share that look at a capture which no spec names yet."""

from __future__ import annotations

from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from photonpano.errors import Problem
    from photonpano.protocols import Source
    from photonpano.specs import Plan

CapturePath = Annotated[
    Path, typer.Argument(metavar="PATH", help="A capture, which is a file or a folder; or a spec (.yaml).", show_default=False)
]
SourceName = Annotated[
    str | None,
    typer.Option(
        "--source", metavar="NAME", help="The source that reads it; by default the one that recognises it.", show_default=False
    ),
]
Keys = Annotated[
    list[str] | None,
    typer.Option(
        "--with",
        metavar="KEY=VALUE",
        help="A key of the source, such as frame_rate_hz=96800; may be given several times.",
        show_default=False,
    ),
]
Corrections = Annotated[
    list[str] | None,
    typer.Option(
        "--correct",
        metavar="CORRECTION",
        help="A correction, as in a spec, such as rot90 or '{crop: {rows: [2, null]}}'; may be given several times.",
        show_default=False,
    ),
]

SPEC_SUFFIXES = {".yaml", ".yml"}


def is_spec(path: Path) -> bool:
    """Tell whether a path is that of a spec."""
    return path.suffix.lower() in SPEC_SUFFIXES


def plan_for(
    path: Path,
    source: str | None = None,
    keys: Sequence[str] | None = None,
    corrections: Sequence[str] | None = None,
    overrides: Sequence[str] = (),
) -> Plan:
    """Make the plan of a capture that is given by its path, or by a spec.

    Args:
        path: the capture, or a spec.
        source: what specs call the source that reads it.
        keys: its keys, such as `frame_rate_hz=96800`.
        corrections: items of the spec's list of corrections, in YAML; they take the place of those of a spec.
        overrides: other values of the spec.

    Raises:
        SpecError: the spec is wrong.
        WrongArgumentError: nothing recognises the capture, or an option is wrong.
    """
    from photonpano.cli.outcome import WrongArgumentError
    from photonpano.specs import load_spec, parse_spec

    for key in keys or ():
        if "=" not in key:
            raise WrongArgumentError(f"--with {key}: expected KEY=VALUE, such as frame_rate_hz=96800")
    changes = [f"source.with.{key}" for key in keys or ()]
    if source is not None:
        changes.append(f"source.use={source}")
    if corrections:
        changes.append(f"corrections=[{', '.join(corrections)}]")
    changes += overrides
    if is_spec(path):
        return load_spec(path, changes)
    with _blaming_options(source):
        return parse_spec({"version": 1, "source": {"use": "auto", "with": {"path": path}}}, overrides=changes)


@contextmanager
def opened(
    path: Path,
    source: str | None = None,
    keys: Sequence[str] | None = None,
    corrections: Sequence[str] | None = None,
    overrides: Sequence[str] = (),
) -> Iterator[tuple[Plan, Source]]:
    """Open a capture that is given by its path, or by a spec: see `plan_for`.

    What does not suit it may show as late as in the block, and is told by the name of the option as well.

    Raises:
        InputError: the capture cannot be read.
    """
    from photonpano.pipeline.components import build_source

    plan = plan_for(path, source, keys, corrections, overrides)
    with nullcontext() if is_spec(path) else _blaming_options(source), build_source(plan) as capture:
        yield plan, capture


@contextmanager
def _blaming_options(source: str | None) -> Iterator[None]:
    """Say what is wrong without naming a spec that nobody wrote."""
    from photonpano.cli.outcome import WrongArgumentError
    from photonpano.errors import SpecError

    try:
        yield
    except SpecError as error:
        raise WrongArgumentError("\n".join(_told(each, source) for each in error.problems)) from error


def _told(problem: Problem, source: str | None) -> str:
    """Say what is wrong by the name of the option, if one has brought it in."""
    where = problem.where
    if where in ("", "source", "source.with.path") or (where == "source.use" and source is None):
        return problem.message
    if where.startswith("corrections"):
        return f"--correct: {problem.message}"
    option = "--source" if where == "source.use" else where.replace("source.with.", "--with ", 1)
    return f"{option}: {problem.message}"
