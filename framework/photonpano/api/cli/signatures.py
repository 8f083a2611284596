"""Make commands of functions: options, arguments, help and plans come from their signatures and docstrings."""

from __future__ import annotations

import importlib
import inspect
import re
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from copy import copy
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Union, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperCommand
from typer.models import OptionInfo

from photonpano.api.cli.errors import reported
from photonpano.api.cli.verbosity import verbosity_of, with_verbosity
from photonpano.api.command import CHANGES, COMMANDS, SPEC, Command, WrongArgumentError, component_names

if TYPE_CHECKING:
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
SETTINGS = {"help_option_names": ["-h", "--help"], "max_content_width": 100}
_GIVEN = {"plan", "progress", "catalog", "resumed"}  # parameters without an option
# Options and arguments that several commands have
_USUAL: dict[str, Any] = {
    "run_folder": typer.Argument(metavar="RUN", help="A run folder."),
    "output": typer.Option("--output", "-o", metavar="DIR"),
    "capture": typer.Option(metavar="PATH"),
    "changes": typer.Option("--set", metavar="KEY=VALUE"),
    "strict": typer.Option(help="Exit with 1 if the verdict is doubtful."),
    "as_json": typer.Option("--json", help="Print JSON, for programs."),
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


class LoadedCommand(TyperCommand):
    """A command with -v, -q and --log, whose errors become a message and an exit code."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters."""
        return with_verbosity(super().get_params(ctx))

    def invoke(self, ctx: Any) -> Any:
        """Run the command."""
        with verbosity_of(ctx), reported(debug=ctx.find_root().params["debug"]):
            return super().invoke(ctx)


def loaded(words: str, module: str) -> Any:
    """Import the module of a command such as `plugins list`, and return the command."""
    importlib.import_module(module)
    declared = COMMANDS[words.replace(" ", "-")]
    text, _ = _documented(declared.function)
    example = f"\n\nExample: photonpano {' '.join(filter(None, [words, declared.example]))}"
    app = typer.Typer(add_completion=False, rich_markup_mode=None, context_settings=SETTINGS)
    app.command(words.rpartition(" ")[2], cls=LoadedCommand, help=text + example)(_callback(declared))
    return typer.main.get_command(app)


def _callback(declared: Command) -> Callable[..., None]:
    own = [name for name in inspect.signature(declared.function).parameters if name not in _GIVEN]
    printing = [name for name, each in inspect.signature(declared.prints).parameters.items() if each.kind is each.KEYWORD_ONLY]

    def callback(**given: Any) -> None:
        with _arguments(declared, given) as arguments:
            result = (declared.calls or declared.function)(**arguments)
        for line in declared.prints(result, **{name: given[name] for name in printing}):
            typer.echo(line)

    parameters = [
        *(_parameter(name, *how) for name, how in PLANS[declared.plan].items()),
        *_options(declared, declared.function, own),
        *(_parameter(name, str, option, None) for name, option in declared.settings.items()),
        *_options(declared, declared.prints, [name for name in printing if name not in own]),
    ]
    callback.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    callback.__annotations__ = {each.name: each.annotation for each in parameters}
    return callback


@contextmanager
def _arguments(declared: Command, given: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Make the arguments of the function from the options that are given."""
    from photonpano.api.cli.progress import progress_for_stderr
    from photonpano.plugins.registry import discover

    takes = inspect.signature(declared.function).parameters
    arguments = {name: value for name, value in given.items() if name in takes and value is not None}
    settings = {name: given[name] for name in declared.settings if given[name] is not None}
    if settings:
        arguments["changes"] = [*arguments.get("changes", ()), *(_setting(*each) for each in settings.items())]
    if "progress" in takes:
        notes = given[declared.notes] if isinstance(declared.notes, str) else declared.notes
        arguments["progress"] = progress_for_stderr(notes=notes)
    catalog = discover() if "catalog" in takes else None
    if "catalog" in takes:
        arguments["catalog"] = catalog
    with plan_of(declared.plan, given, catalog) as plan:
        yield arguments if plan is None else arguments | {"plan": plan}


def _setting(name: str, value: str) -> str:
    """Return the override of a value of the section `render`; a box needs no brackets."""
    return f"render.{name}=[{value}]" if "," in value and not value.startswith("[") else f"render.{name}={value}"


def _options(declared: Command, function: Callable[..., Any], names: Sequence[str]) -> Iterator[inspect.Parameter]:
    """Yield parameters of a function, which are options or arguments."""
    parameters, hints = inspect.signature(function).parameters, get_type_hints(function)
    _, texts = _documented(declared.function)
    for name in names:
        option = copy(declared.options.get(name) or _USUAL.get(name) or typer.Option())
        option.help = option.help or texts[name]
        yield _parameter(name, hints[name], option, parameters[name].default)


def _parameter(name: str, hint: Any, option: Any, default: Any) -> inspect.Parameter:
    """Return a parameter of an option or argument, as typer reads it."""
    kind, option = _plain(hint), copy(option)
    if kind is bool and option.default is ...:
        option.default = f"--{name.replace('_', '-')}"  # and no --no-NAME
    if get_origin(kind) is list and isinstance(option, OptionInfo):
        option.help = f"{option.help} Repeatable."
    if default in (None, ()):
        kind, default = kind | None, None
    default = inspect.Parameter.empty if default is ... else default
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option])


def _plain(hint: Any) -> Any:
    """Return the one type that the command line reads where a function takes several."""
    if get_origin(hint) is Sequence:
        return list[_plain(get_args(hint)[0])]  # type: ignore[misc]
    if get_origin(hint) not in (Union, types.UnionType):
        return hint
    each = [kind for kind in get_args(hint) if kind is not types.NoneType]
    return next((kind for kind in (Path, str) if kind in each), each[0])


def _documented(function: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """Return what a docstring in the style of Google says of a function, and of each of its parameters."""
    text, *sections = re.split(r"^(Args|Returns|Yields|Raises):\n", inspect.getdoc(function) or "", flags=re.MULTILINE)
    given = dict(zip(sections[::2], sections[1::2], strict=True)).get("Args", "")
    names = inspect.signature(function).parameters

    def shown(found: re.Match[str]) -> str:
        return f"--{found[1].replace('_', '-')}" if found[1] in names else f"'{found[1]}'"

    def plain(text: str) -> str:
        return re.sub(r"`([^`]+)`", shown, text).strip()

    texts = {}
    for name, words in re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", given, re.MULTILINE):
        sentence = plain(" ".join(words.split()))
        texts[name] = f"{sentence[0].upper()}{sentence[1:].rstrip('.')}."
    return plain(text), texts
