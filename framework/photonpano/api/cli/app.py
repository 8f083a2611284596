"""The program `photonpano`. The module of a command is imported when it is used: that keeps `--help` fast.

Plugins add commands by entry points of the group `photonpano.commands`: the name of a command, and the module that declares it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from contextlib import suppress
from functools import cached_property
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

import photonpano
from photonpano.api.cli.errors import end_on_signals, prepare_streams
from photonpano.api.cli.signatures import SETTINGS, loaded
from photonpano.api.cli.verbosity import with_verbosity

# The commands as `--help` lists them: the module of `api` that declares each, and its line there.
_COMMANDS = {
    "demo": ("simulated", "Simulate a small capture, make its panorama, and score it."),
    "info": ("looks", "Print size, brightness and speed of a capture, and a spec."),
    "check": ("specs", "Check a spec without running it."),
    "run": ("run", "Make a panorama from a spec."),
    "batch": ("batch", "Run one spec on many captures, and write one summary."),
    "check-run": ("judging", "Judge a finished run by its capture."),
    "verify": ("run_folders", "Verify that a run folder is as its run wrote it."),
    "evaluate": ("judging", "Score a run against the truth of its capture."),
    "compare": ("judging", "Lay runs of one capture side by side."),
    "render": ("rendering", "Render a finished run again, with other settings."),
    "video": ("rendering", "Make a video along the motion of a finished run."),
    "clean": ("run_folders", "Remove what killed processes have left."),
    "convert": ("copies", "Convert binary frames to a packed .npy file or a zarr array."),
    "dark": ("copies", "Measure dark counts and hot pixels, with the lens covered."),
    "explain": ("specs", "Print a spec with all defaults, explained in comments."),
    "preview": ("looks", "Merge frames into pictures, to look at a capture."),
    "schema": ("specs", "Print the JSON Schema of specs, for editors."),
    "simulate": ("simulated", "Write a simulated capture with its truth to a packed .npy file."),
    "warm-up": ("simulated", "Compile the loops over pixels for this machine."),
    "plugins list": ("plugins", "List components that a spec can use, with their plugins."),
    "plugins show": ("plugins", "Describe a component: its keys, and YAML to paste."),
}
_OFFERED = "photonpano.commands"  # the entry-point group
_GROUPS = {"plugins": "List and describe the components of the installed plugins."}


def _offered() -> dict[str, tuple[str, str]]:
    """Return the modules of the commands of plugins, and the first line of each, which is read without importing it."""
    offered = {}
    for each in entry_points(group=_OFFERED):
        with suppress(ModuleNotFoundError, SyntaxError):  # a damaged plugin costs its own commands only
            spec = find_spec(each.value)
            text = Path(spec.origin).read_text(encoding="utf-8") if spec is not None and spec.origin else ""
            first, _, _ = (ast.get_docstring(ast.parse(text)) or "").partition("\n")
            offered[each.name] = (each.value, first)
    return offered


class _Command(TyperCommand):
    """A command whose module is imported when it is used."""

    def __init__(self, words: str, module: str, summary: str) -> None:
        super().__init__(words.rpartition(" ")[2], short_help=summary)
        self.words, self._module = words, module

    @cached_property
    def loaded(self) -> Any:
        return loaded(self.words, self._module)

    def make_context(self, *arguments: Any, **options: Any) -> Any:
        return self.loaded.make_context(*arguments, **options)


class _Commands(TyperGroup):
    """Commands; with -v, -q and --log before the name."""

    def get_params(self, ctx: Any) -> list[Any]:
        return with_verbosity(super().get_params(ctx))


class _Program(_Commands):
    """All commands, some of them in groups."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        groups = {}
        own = {words: (f"photonpano.api.{module}", summary) for words, (module, summary) in _COMMANDS.items()}
        for words, (module, summary) in (own | _offered()).items():
            group, _, _ = words.rpartition(" ")
            if group and group not in groups:
                help_of_group: Any = {"help": _GROUPS[group], "no_args_is_help": True, "rich_markup_mode": None}
                groups[group] = _Commands(name=group, context_settings=SETTINGS, **help_of_group)
                self.add_command(groups[group])
            groups.get(group, self).add_command(_Command(words, module, summary))


app = typer.Typer(
    name="photonpano",
    cls=_Program,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings=SETTINGS,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"photonpano {photonpano.__version__}")
        raise typer.Exit


@app.callback()
def photonpano_options(
    version: Annotated[  # its callback does the work
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    debug: Annotated[  # read before the command runs
        bool, typer.Option("--debug", envvar="PHOTONPANO_DEBUG", help="Show the Python traceback of errors.")
    ] = False,
) -> None:
    """Make panoramas from the frames of single-photon cameras.

    'info' looks at a capture and prints a spec: a YAML file that names the capture and the method. 'check' it, then 'run' it.

    Exit codes: 0 success, 1 failure, 2 wrong spec or command line.
    """


def commands() -> dict[str, Any]:
    """Import all commands, and return them by their names, such as `plugins list`."""

    def inside(group: Any) -> Iterator[tuple[str, Any]]:
        for each in group.commands.values():
            yield from [(each.words, each.loaded)] if isinstance(each, _Command) else inside(each)

    return dict(inside(typer.main.get_command(app)))


def main() -> None:
    """Run the program with the arguments of the process."""
    prepare_streams()
    end_on_signals()
    app(prog_name="photonpano")  # with "python -m photonpano", completion would not work
