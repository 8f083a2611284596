"""A command of the program: its errors are reported, and it says as much as is wanted."""

from typing import Any

from typer.core import TyperCommand

from photonpano.cli.errors import reported
from photonpano.cli.verbosity import verbosity_of, with_verbosity


class Command(TyperCommand):
    """A command with -v, -q and --log."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters."""
        return with_verbosity(super().get_params(ctx))

    def invoke(self, ctx: Any) -> Any:
        """Run the command; its errors become a message and an exit code."""
        with verbosity_of(ctx), reported(debug=ctx.find_root().params["debug"]):
            return super().invoke(ctx)
