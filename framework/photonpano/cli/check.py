"""photonpano check."""

import typer

from photonpano.cli.options import Overrides, SpecPath


def check(spec: SpecPath, overrides: Overrides = None) -> None:
    """Check a spec without running it.

    Prints every problem with its file, line and column, and exits with 2 if there is one. Opens the capture to check the
    stages against its size, and samples the frames of packed .npy files: what depends on all frames stays open.

    Example: photonpano check scan.yaml
    """
    from photonpano.pipeline.components import foreseen_groups, open_source
    from photonpano.specs import load_spec

    plan = load_spec(spec, overrides or ())
    with open_source(plan) as source:
        count = len(plan.levels)
        levels = f"{'up to ' if plan.until_converged else ''}{count} level{'' if count == 1 else 's'}"
        typer.echo(f"{spec}: ok, {levels} on {plan.source.contribution.name}: {source.info}")
        for decision in plan.decisions:
            typer.echo(f"{decision.what} is {decision.value}: {decision.reason}")
        for reason in dict.fromkeys(groups for groups in foreseen_groups(plan, source) if isinstance(groups, str)):
            typer.echo(f"groups are {reason}")
