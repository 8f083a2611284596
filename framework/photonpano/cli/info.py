"""photonpano info."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import typer

from photonpano.cli.options import CapturePath, Corrections, Json, Keys, SourceName

if TYPE_CHECKING:
    from photonpano.api.capture_info import CaptureInfo


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
    typer.echo(columns(list(_rows(found))))
    for warning in found.warnings:
        warn(warning)
    spec = "\n".join(f"{section}: {flow(value)}" for section, value in found.spec.items())
    typer.echo(f"\nA spec to start from:\n\n{spec}")


def _rows(found: "CaptureInfo") -> Iterator[list[str]]:
    from photonpano.api.capture_info import percent
    from photonpano.text import duration

    speed, size = found.speed_px, found.group_size
    yield ["source", found.source + (f" ({found.reason})" if found.reason else "")]
    yield ["capture", str(found.stream)]
    yield ["duration", "unknown without frame_rate_hz" if found.seconds is None else duration(found.seconds)]
    yield ["flux", f"{found.flux:.3g} photons per pixel per frame"]
    yield ["hot pixels", f"about {percent(found.hot_share)}" if found.hot_share else "none"]
    yield ["still", found.still_how]
    yield ["speed", found.speed_how if speed is None else f"{speed:.2g} px per frame ({found.speed_how})"]
    yield ["group size", "unknown" if size is None else f"{size}: {found.group_size_reason}"]
