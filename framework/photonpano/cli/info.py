"""photonpano info."""

import typer

from photonpano.cli.options import CapturePath, Corrections, Json, Keys, SourceName


def info(
    path: CapturePath,
    source: SourceName = None,
    keys: Keys = None,
    corrections: Corrections = None,
    as_json: Json = False,
) -> None:
    """Print size, brightness and speed of a capture, and a spec.

    Reads some thousands of frames, spread over the capture. The spec at the end is one to start from.

    Example: photonpano info cube.npy --with frame_rate_hz=96800
    """
    import json
    from dataclasses import asdict

    from photonpano.api.capture_info import info as capture_info
    from photonpano.cli.errors import warn
    from photonpano.cli.options import capture_plan
    from photonpano.cli.tables import columns
    from photonpano.registry import discover
    from photonpano.registry.description import flow

    catalog = discover()
    with capture_plan(path, source, keys, corrections, catalog) as plan:
        found = capture_info(plan, catalog)
    if as_json:
        typer.echo(json.dumps(asdict(found), indent=2))
        return
    typer.echo(columns(found.rows()))
    for warning in found.warnings:
        warn(warning)
    spec = "\n".join(f"{section}: {flow(value)}" for section, value in found.spec.items())
    typer.echo(f"\nA spec to start from:\n\n{spec}")
