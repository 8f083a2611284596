"""Check a spec without running it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from photonpano.api.command import CHANGES, SPEC, command
from photonpano.pipeline.components import foreseen_groups, open_source
from photonpano.specs import load_spec
from photonpano.text import counted


@command("scan.yaml", lambda lines: lines, spec=SPEC, changes=CHANGES)
def _check(spec: Path, changes: Sequence[str] = ()) -> Iterator[str]:
    """Check a spec without running it.

    Prints every problem with its file, line and column, and exits with 2 if there is one. Opens the capture to check the
    stages against its size, and samples the frames of packed .npy files: what depends on all frames stays open.
    """
    plan = load_spec(spec, changes)
    with open_source(plan, look=False) as source:
        what = f"poses by {plan.pose.contribution.name}" if plan.pose else counted(len(plan.levels), "level")
        up_to = "up to " if plan.until_converged else ""
        yield f"{spec}: ok, {up_to}{what} on {plan.source.contribution.name}: {source.info}"
        if (found := plan.recognised) is not None:
            yield f"{found.what} is {found.value}: {found.reason}"
        for reason in dict.fromkeys(groups for groups in foreseen_groups(plan, source) if isinstance(groups, str)):
            yield f"groups are {reason}"
