"""Check a spec without running it, and print the JSON Schema of specs."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import typer

from photonpano.api.command import CHANGES, SPEC, command
from photonpano.files.folders import atomic_path, require_new
from photonpano.pipeline.components import foreseen_groups, open_source
from photonpano.plugins.registry import discover
from photonpano.specs import json_schema, load_spec
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


@command("--output photonpano.schema.json", lambda line: [line], output=typer.Option("--output", "-o", metavar="FILE"))
def schema(output: Path | None = None, *, overwrite: bool = False) -> str:
    """Print the JSON Schema of specs, for editors.

    The schema holds the keys of all installed plugins. Editors with a YAML language server complete and check specs whose first
    line is '# yaml-language-server: $schema=FILE'.

    Args:
        output: write the schema to a file instead of printing it.
        overwrite: replace the file that is there under this name.
    """
    text = json.dumps(json_schema(discover()), indent=2, ensure_ascii=False)
    if output is None:
        return text
    require_new(output, overwrite)
    with atomic_path(output) as temporary:
        temporary.write_text(f"{text}\n", encoding="utf-8")
    return str(output)
