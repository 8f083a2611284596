"""photonpano schema."""

from pathlib import Path
from typing import Annotated

import typer


def schema(
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FILE", help="Write the schema to a file instead of printing it.", show_default=False
        ),
    ] = None,
) -> None:
    """Print the JSON Schema of specs, for editors.

    The schema holds the keys of all installed plugins. Editors with a YAML language server complete and check specs whose first
    line is '# yaml-language-server: $schema=FILE'.

    Example: photonpano schema --output photonpano.schema.json
    """
    import json

    from photonpano.atomic import atomic_path
    from photonpano.registry import discover
    from photonpano.specs import json_schema

    text = json.dumps(json_schema(discover()), indent=2, ensure_ascii=False)
    if output is None:
        typer.echo(text)
        return
    with atomic_path(output) as temporary:
        temporary.write_text(f"{text}\n", encoding="utf-8")
    typer.echo(output)
