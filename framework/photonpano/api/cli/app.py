"""The program `photonpano`. The module of a command is imported when it is used: that keeps `--help` fast."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
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
    "export": ("export", "Write poses of a camera for other programs, and pictures with them."),
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
_GROUPS = {"plugins": "List and describe the components of the installed plugins."}


class _Command(TyperCommand):
    """A command whose module is imported when it is used."""

    def __init__(self, words: str, module: str, summary: str) -> None:
        super().__init__(words.rpartition(" ")[2], short_help=summary)
        self.words, self._module = words, module

    @cached_property
    def loaded(self) -> Any:
        return loaded(self.words, f"photonpano.api.{self._module}")

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
        for words, (module, summary) in _COMMANDS.items():
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
