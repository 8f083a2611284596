"""The program `photonpano`. Commands import their modules when they run, to keep `--help` fast."""

from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import photonpano
from photonpano.cli.batch import batch
from photonpano.cli.check import check
from photonpano.cli.check_run import check_run
from photonpano.cli.clean import clean
from photonpano.cli.command import Command
from photonpano.cli.compare import compare
from photonpano.cli.convert import convert
from photonpano.cli.dark import dark
from photonpano.cli.ending import end_on_signals, leave
from photonpano.cli.errors import FAILED, SIGNALLED, print_error
from photonpano.cli.evaluate import evaluate
from photonpano.cli.explain import explain
from photonpano.cli.export import export
from photonpano.cli.info import info
from photonpano.cli.plugins import plugins
from photonpano.cli.preview import preview
from photonpano.cli.render import render
from photonpano.cli.run import run
from photonpano.cli.schema import schema
from photonpano.cli.simulate import simulate
from photonpano.cli.streams import prepare_streams
from photonpano.cli.verbosity import with_verbosity
from photonpano.cli.verify import verify
from photonpano.cli.video import video
from photonpano.cli.warm_up import warm_up
from photonpano.errors import OutputError
from photonpano.interrupts import interrupted_by


class _Commands(TyperGroup):
    """The commands."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters."""
        return with_verbosity(super().get_params(ctx))


app = typer.Typer(
    name="photonpano",
    cls=_Commands,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)
_COMMANDS = (
    *(run, batch, check, check_run, verify, render, video, explain, info, preview),
    *(convert, export, simulate, dark, evaluate, compare, clean, schema, warm_up),
)
for command in _COMMANDS:
    app.command(cls=Command)(command)
app.add_typer(plugins, name="plugins")


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


def main() -> None:
    """Run the program with the arguments of the process."""
    prepare_streams()
    end_on_signals()
    try:
        app(prog_name="photonpano")  # with "python -m photonpano", completion would not work
    except SystemExit as error:
        leave(error.code if isinstance(error.code, int) else FAILED)
    except KeyboardInterrupt:  # before the command or after it
        leave(SIGNALLED + interrupted_by())
    except OutputError as error:  # while help is printed
        leave(print_error(error))
