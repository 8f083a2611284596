"""Arguments and options that several commands share, and the plans that they name."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from photonpano.errors import Problem
    from photonpano.registry import Catalog
    from photonpano.specs import Plan

SpecPath = Annotated[Path, typer.Argument(metavar="SPEC", help="The spec: a YAML file.", show_default=False)]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a value of the spec, such as run.seed=1 or levels.0.scale=0.5. Repeatable.",
        show_default=False,
    ),
]
CapturePath = Annotated[
    str, typer.Argument(metavar="PATH", help="A capture (a file, a folder, or a URL), or a spec (.yaml).", show_default=False)
]


def component_names(*kinds: str) -> Callable[[str], list[str]]:
    """Return what completes the name of a component.

    Args:
        kinds: of the components; by default all.
    """

    def complete(incomplete: str) -> list[str]:
        from photonpano.registry import discover

        rows = discover().rows
        return sorted({each.name for each in rows if each.name.startswith(incomplete) and (not kinds or each.kind in kinds)})

    return complete


SourceName = Annotated[
    str | None,
    typer.Option(
        "--source",
        metavar="NAME",
        autocompletion=component_names("source"),
        help="The source that reads the capture; by default the one that recognises it.",
        show_default=False,
    ),
]
Keys = Annotated[
    list[str] | None,
    typer.Option(
        "--with",
        metavar="KEY=VALUE",
        help="Set a key of the source, such as frame_rate_hz=96800. Repeatable.",
        show_default=False,
    ),
]
Corrections = Annotated[
    list[str] | None,
    typer.Option(
        "--correct",
        metavar="CORRECTION",
        help="Apply a correction, as in a spec, such as rot90 or '{crop: {rows: [2, null]}}'. Repeatable.",
        show_default=False,
    ),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Write beside other files, which stay, or replace a run of another capture.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")]


@contextmanager
def capture_plan(
    path: str | Path,
    source: str | None = None,
    keys: Sequence[str] | None = None,
    corrections: Sequence[str] | None = None,
    catalog: Catalog | None = None,
) -> Iterator[Plan]:
    """Make the plan of a capture that is given by its path, or by a spec.

    Errors of the options, in making the plan and in the block, name the option instead of a key of a spec that nobody wrote.

    Args:
        path: the capture, which may be a URL, or a spec.
        source: the source that reads it.
        keys: its keys, such as `frame_rate_hz=96800`.
        corrections: items of the spec's list of corrections, in YAML; they replace those of a spec.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        SpecError: the spec is wrong.
        WrongArgumentError: no source recognises the capture, or an option is wrong.
    """
    from photonpano import specs
    from photonpano.cli.errors import WrongArgumentError
    from photonpano.errors import SpecError

    for key in keys or ():
        if "=" not in key:
            raise WrongArgumentError(f"--with {key}: expected KEY=VALUE, such as frame_rate_hz=96800")
    changes = [f"source.with.{key}" for key in keys or ()]
    if source is not None:
        changes.append(f"source.use={source}")
    if corrections:
        changes.append(f"corrections=[{', '.join(corrections)}]")
    if Path(path).suffix.lower() in specs.SPEC_SUFFIXES:
        yield specs.load_spec(path, changes, catalog=catalog)
        return
    try:
        yield specs.capture_plan(path, overrides=changes, catalog=catalog)
    except SpecError as error:
        raise WrongArgumentError("\n".join(_message(each, source) for each in error.problems)) from error


def _message(problem: Problem, source: str | None) -> str:
    """Return the message of a problem, after the option that set the value, if one did."""
    where = problem.where
    if where in ("", "source", "source.with.path") or (where == "source.use" and source is None):
        return problem.message
    if where.startswith("corrections"):
        return f"--correct: {problem.message}"
    option = "--source" if where == "source.use" else where.replace("source.with.", "--with ", 1)
    return f"{option}: {problem.message}"
