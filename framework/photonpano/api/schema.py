"""Print the JSON Schema of specs, for editors."""

from __future__ import annotations

import json
from pathlib import Path

import typer

from photonpano.api.command import command
from photonpano.files.atomic import atomic_path
from photonpano.files.folders import require_new
from photonpano.plugins.registry import discover
from photonpano.specs import json_schema


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
