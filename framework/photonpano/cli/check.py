"""photonpano check."""

import typer

from photonpano.cli.arguments import Overrides, Spec


def check(spec: Spec, overrides: Overrides = None) -> None:
    """Find everything that is wrong with a spec, without running it.

    Prints each problem with its file, line and column, and ends with exit code 2 if there are any. Opens the capture, so
    that the stages are checked against its size, and reads none of its frames: what depends on them is left open.

    Example: photonpano check scan.yaml
    """
    from photonpano.cli.wording import capture_words
    from photonpano.pipeline.components import foreseen_groups, open_source
    from photonpano.specs import load_spec

    plan = load_spec(spec, overrides or ())
    with open_source(plan) as source:
        count = len(plan.levels)
        levels = f"{'up to ' if plan.until_converged else ''}{count} level{'' if count == 1 else 's'}"
        typer.echo(f"{spec}: ok, {levels} on {plan.source.contribution.name}: {capture_words(source.info)}")
        for decision in plan.decisions:
            typer.echo(f"{decision.what} is {decision.value}: {decision.reason}")
        for reason in dict.fromkeys(groups for groups in foreseen_groups(plan, source) if isinstance(groups, str)):
            typer.echo(f"groups are {reason}")
