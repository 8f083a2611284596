"""Declare commands of the program: a function, the lines that it prints, and how its parameters are given.

`photonpano.api.cli.app` lists the modules of `api` that declare them. The signature and the docstring of the function give
options and help: see `photonpano.api.cli.signatures`.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import typer

from photonpano.errors import PhotonpanoError

if TYPE_CHECKING:
    from photonpano.values.verdict import Verdict

FunctionT = TypeVar("FunctionT", bound=Callable[..., Any])
logger = logging.getLogger("photonpano")
SPEC = typer.Argument(metavar="SPEC", help="The spec: a YAML file.")
CHANGES = typer.Option(
    "--set", metavar="KEY=VALUE", help="Change a value of the spec, such as run.seed=1 or levels.0.scale=0.5."
)
COMMANDS: dict[str, Command] = {}  # the commands whose modules are imported, by name


class WrongArgumentError(PhotonpanoError):
    """An argument or an option of a command is wrong."""


class DoubtfulError(PhotonpanoError):
    """A run is doubtful, and only a trusted one is a success."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """A command of the program."""

    function: Callable[..., Any]  # does the work; its signature and docstring give the options
    # turns the result into the lines of standard output; its keyword-only parameters are options as well
    prints: Callable[..., Iterable[str]]
    example: str = ""  # the words after the name of the command, for its help
    plan: Literal["spec", "capture"] | None = None  # what gives the parameter `plan`: a spec, or a capture with options
    # options that stand for values of the section `render`, as `--scale 2` for `--set render.scale=2`
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: bool | str = False  # whether the notes of the progress are printed without a terminal, or the option that decides it
    calls: Callable[..., Any] | None = None  # is called in place of `function`, with the same parameters
    # how parameters are given, where names, types and docstring do not say it
    options: Mapping[str, Any] = field(default_factory=dict)


def command(example: str, prints: Callable[..., Iterable[str]], **declared: Any) -> Callable[[FunctionT], FunctionT]:
    """Make a function the command of its name; attributes that `Command` does not have are items of its `options`."""
    own = {name: declared.pop(name) for name in ("plan", "settings", "notes", "calls") if name in declared}

    def declare(function: FunctionT) -> FunctionT:
        name = function.__name__.lstrip("_").replace("_", "-")
        COMMANDS[name] = Command(function=function, prints=prints, example=example, options=declared, **own)
        return function

    return declare


def component_names(*kinds: str) -> Callable[[str], list[str]]:
    """Return a function that completes the name of a component of these kinds; of any kind if none is given."""

    def complete(incomplete: str) -> list[str]:
        from photonpano.plugins.registry import discover

        rows = discover().rows
        return sorted({each.name for each in rows if each.name.startswith(incomplete) and (not kinds or each.kind in kinds)})

    return complete


def warn(message: str) -> None:
    """Print a warning on standard error, once the command runs."""
    logger.warning("%s", message)


def json_lines(data: Any) -> list[str]:
    """Return data as JSON, for programs."""
    return [json.dumps(data, indent=2)]


def verdict_lines(verdict: Verdict) -> list[str]:
    """Return the status, notes, and what was not tested; each reason of a doubtful one is a sentence on standard error."""
    for reason in verdict.reasons:
        typer.echo(f"doubtful: {reason}", err=True)
    notes = [f"note      {each.finding}" for each in verdict.notes]
    untested = [f"untested  {'; '.join(verdict.untested)}"] if verdict.untested else []
    return [f"verdict   {verdict.status}", *notes, *untested]


def require_trust(verdict: Verdict, files: str) -> None:
    """Raise `DoubtfulError` if a verdict is doubtful; `files` is a clause about what became of the files."""
    if verdict.status != "trusted":
        raise DoubtfulError(f"the verdict is doubtful, and --strict accepts only a trusted one; {files}")
