"""Plans that a command line names: a spec with changes, or a capture with options."""

from __future__ import annotations

from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from photonpano.api.command import CHANGES, SPEC, WrongArgumentError, component_names

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from photonpano.errors import Problem
    from photonpano.plugins.registry import Catalog
    from photonpano.specs import Plan


_PATH = typer.Argument(metavar="PATH", help="A capture (a file, a folder, or a URL), or a spec (.yaml).")
_SOURCE = typer.Option(
    metavar="NAME",
    autocompletion=component_names("source"),
    help="The source that reads the capture; by default the one that recognises it.",
)
_KEYS = typer.Option("--with", metavar="KEY=VALUE", help="Set a key of the source, such as frame_rate_hz=96800.")
_CORRECTIONS = typer.Option(
    "--correct",
    metavar="CORRECTION",
    help="Apply a correction, as in a spec, such as rot90 or '{crop: {rows: [2, null]}}'.",
)
# The type, option and default of each option that gives a plan
PLANS: dict[str | None, dict[str, tuple[Any, Any, Any]]] = {
    None: {},
    "spec": {"spec": (Path, SPEC, ...), "changes": (list[str], CHANGES, None)},
    "capture": {
        "path": (str, _PATH, ...),
        "source": (str, _SOURCE, None),
        "keys": (list[str], _KEYS, None),
        "corrections": (list[str], _CORRECTIONS, None),
    },
}


def plan_of(kind: str | None, given: Mapping[str, Any], catalog: Catalog | None = None) -> AbstractContextManager[Plan | None]:
    """Make the plan that options give, if they give one."""
    from photonpano.specs import load_spec

    if kind == "spec":
        return nullcontext(load_spec(given["spec"], given["changes"] or (), catalog=catalog))
    return capture_plan(**{name: given[name] for name in PLANS[kind]}, catalog=catalog) if kind else nullcontext()


@contextmanager
def capture_plan(
    path: str | Path,
    source: str | None = None,
    keys: Sequence[str] | None = None,
    corrections: Sequence[str] | None = None,
    catalog: Catalog | None = None,
) -> Iterator[Plan]:
    """Make the plan of a capture that is given by its path or URL, or by a spec, whose corrections are replaced.

    Errors of the options, in making the plan and in the block, name the option instead of a key of a spec that nobody wrote.

    Raises:
        SpecError: the spec is wrong.
        WrongArgumentError: no source recognises the capture, or an option is wrong.
    """
    from photonpano import specs
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
