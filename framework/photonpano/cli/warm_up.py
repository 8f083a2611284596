"""photonpano warm-up."""

import typer


def warm_up() -> None:
    """Compile the loops over pixels for this machine.

    Otherwise the first run compiles them. The result is kept beside the installed package, or in your home folder if that
    cannot be written, until the package or the machine changes.

    Example: photonpano warm-up
    """
    from photonpano.api.runs import warm_up as compile_loops

    typer.echo(f"ready after {compile_loops():.0f} s")
