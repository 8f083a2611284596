"""photonpano explain."""

from typing import Annotated

import typer

from photonpano.cli.options import Overrides, SpecPath


def explain(
    spec: SpecPath,
    overrides: Overrides = None,
    forecast: Annotated[
        bool, typer.Option("--forecast", help="Try the middle of the capture, and predict time and memory of the run.")
    ] = False,
) -> None:
    """Print a spec with all defaults, explained in comments.

    The output is a spec itself. Its comments name the plugin of each component, mark defaults and values of --set, and give
    the number of groups and pairs of each level.

    Example: photonpano explain scan.yaml > resolved.yaml
    """
    from photonpano.api.explanation import explain as explanation
    from photonpano.registry import discover
    from photonpano.specs import load_spec

    catalog = discover()
    plan = load_spec(spec, overrides or (), catalog=catalog)
    typer.echo(explanation(plan, with_forecast=forecast, catalog=catalog), nl=False)
