"""The program `photonpano`. A command is a module of `api`, which is imported when it is used: that keeps `--help` fast."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

import photonpano
from photonpano import api
from photonpano.api.cli.errors import end_on_signals
from photonpano.api.cli.signatures import SETTINGS, loaded
from photonpano.api.cli.streams import prepare_streams
from photonpano.api.cli.verbosity import with_verbosity

# The commands that `--help` lists before all others
_FIRST = ("demo", "info", "check", "run", "batch", "check_run", "verify", "evaluate", "compare", "render", "video", "export")


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
    """The modules of a package that are commands, and its packages that hold some; with -v, -q and --log before the name."""

    def __init__(self, *, package: str = "photonpano.api", **options: Any) -> None:
        super().__init__(**options)
        folder = Path(api.__path__[0], *package.split(".")[2:])
        places = {name: place for place, name in enumerate(_FIRST)}
        for file in sorted(folder.glob("*.py"), key=lambda file: (places.get(file.stem, len(places)), file.stem)):
            if "\n@command(" in file.read_text(encoding="utf-8"):
                words = " ".join([*package.split(".")[2:], file.stem.replace("_", "-")])
                self.add_command(_Command(words, f"{package}.{file.stem}", _first_line(file)))
        for file in sorted(folder.glob("*/__init__.py")):
            name = file.parent.name
            help_of_group: Any = {"help": _first_line(file), "no_args_is_help": True, "rich_markup_mode": None}
            group = _Commands(name=name, package=f"{package}.{name}", context_settings=SETTINGS, **help_of_group)
            if group.commands:
                self.add_command(group)

    def get_params(self, ctx: Any) -> list[Any]:
        return with_verbosity(super().get_params(ctx))


def _first_line(file: Path) -> str:
    return file.read_text(encoding="utf-8").partition("\n")[0].strip('"')


app = typer.Typer(
    name="photonpano",
    cls=_Commands,
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
