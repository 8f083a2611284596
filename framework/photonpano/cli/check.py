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
    from photonpano.text import counted

    plan = load_spec(spec, overrides or ())
    with open_source(plan, look=False) as source:
        what = f"poses by {plan.pose.contribution.name}" if plan.pose else counted(len(plan.levels), "level")
        up_to = "up to " if plan.until_converged else ""
        typer.echo(f"{spec}: ok, {up_to}{what} on {plan.source.contribution.name}: {source.info}")
        for decision in plan.decisions:
            typer.echo(f"{decision.what} is {decision.value}: {decision.reason}")
        for reason in dict.fromkeys(groups for groups in foreseen_groups(plan, source) if isinstance(groups, str)):
            typer.echo(f"groups are {reason}")
