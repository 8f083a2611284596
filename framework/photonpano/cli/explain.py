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
    from photonpano.cli.options import spec_plan
    from photonpano.registry import discover

    catalog = discover()
    plan = spec_plan(spec, overrides, catalog=catalog)
    typer.echo(explanation(plan, with_forecast=forecast, catalog=catalog), nl=False)
