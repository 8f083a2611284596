"""photonpano info."""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from photonpano.cli.capture import CapturePath, Corrections, Keys, SourceName

if TYPE_CHECKING:
    from photonpano.protocols import Source
    from photonpano.specs import Plan
    from photonpano.values import CaptureSummary

HOT_SHARE = 0.001
"""With more hot pixels than this, a mask is recommended."""
SATURATED_SHARE = 0.01
"""With more pixels than this at their highest value in every frame, less light is recommended."""


def info(
    path: CapturePath,
    source: SourceName = None,
    keys: Keys = None,
    corrections: Corrections = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON, for programs.")] = False,
) -> None:
    """Say what a capture is, how bright, and how fast its image moves.

    Reads some hundreds of frames, all over the capture. Ends with a spec to start from.

    Example: photonpano info cube.npy --with frame_rate_hz=96800
    """
    import json

    from photonpano.cli.capture import opened
    from photonpano.cli.outcome import warn
    from photonpano.cli.wording import columns

    # Whatever a spec says of groups, what the capture asks for is told.
    overrides = ["resample={use: midpoint}", "levels=1"]
    with opened(path, source, keys, corrections, overrides) as (plan, capture):
        facts = _facts(plan, capture)
    if as_json:
        typer.echo(json.dumps(facts, indent=2))
        return
    typer.echo(columns(list(_rows(facts))))
    for warning in facts["warnings"]:
        warn(warning)
    typer.echo(f"\nA spec to start from:\n\n{_spec(facts)}")


def _facts(plan: "Plan", source: "Source") -> dict[str, Any]:
    """Look at a capture, and say everything as plain data."""
    from photonpano.captures.summary import saturated_share, summarise
    from photonpano.threads import one_thread_inside, thread_count

    stream = source.info
    with one_thread_inside():
        capture = summarise(source, thread_count(plan.run.threads))
    facts: dict[str, Any] = {
        "source": plan.source.contribution.name,
        "reason": next((decision.reason for decision in plan.decisions if decision.what == "source"), None),
        "n_frames": stream.n_frames,
        "height": stream.height,
        "width": stream.width,
        "kind": stream.kind,
        "bit_depth": stream.bit_depth,
        "frame_rate_hz": stream.frame_rate_hz,
        "seconds": None if stream.frame_rate_hz is None else stream.n_frames / stream.frame_rate_hz,
        "flux": capture.flux,
        "speed_px": capture.speed_px,
        "speed_how": capture.how,
        "unused_share": 1 - float(source.valid.mean()),
        "hot_share": _hot_share(plan, source),
        "saturated_share": saturated_share(source),
        **_group_size(plan, source, capture),
    }
    return facts | {"warnings": list(_warnings(source, facts)), "spec": _document(plan)}


def _hot_share(plan: "Plan", source: "Source") -> float:
    """Return how many of the pixels that may be used the correction `hot-pixels` would mask."""
    from dataclasses import replace

    from photonpano.corrections import HotPixels
    from photonpano.pipeline.components import build_source

    with build_source(replace(plan, corrections=(*plan.corrections, HotPixels()))) as masked:
        return 1 - float(masked.valid[source.valid].mean())


def _group_size(plan: "Plan", source: "Source", capture: "CaptureSummary") -> dict[str, Any]:
    from photonpano.errors import InputError
    from photonpano.pipeline.components import foreseen_decisions

    try:
        decisions = foreseen_decisions(plan, source, capture)
    except InputError as error:
        return {"group_size": None, "group_size_reason": str(error)}
    ((size, reason),) = [(each.value, each.reason) for each in decisions if each.what == "group_size"]
    return {"group_size": size, "group_size_reason": reason}


def _warnings(source: "Source", facts: Mapping[str, Any]) -> Iterator[str]:
    from photonpano.captures.summary import require_photons
    from photonpano.errors import InputError

    try:
        require_photons(source)
    except InputError as error:
        yield str(error)
        return
    if (share := facts["hot_share"]) > HOT_SHARE:
        yield f"about {_percent(share)} of the pixels are hot; the correction hot-pixels masks them"
    if (share := facts["saturated_share"]) > SATURATED_SHARE:
        yield f"{_percent(share)} of the pixels have their highest value in every frame: their flux is unknown; expose less"
    if facts["group_size"] is None:
        yield facts["group_size_reason"]


def _document(plan: "Plan") -> dict[str, Any]:
    """Return the spec of a capture: what differs from defaults, with paths as they count from the current folder."""
    source = {"use": plan.source.contribution.name, "with": _from_here(plan.source.config.model_dump(exclude_defaults=True))}
    corrections = plan.document.get("corrections")
    return {"version": 1, "source": source} | ({"corrections": corrections} if corrections else {})


def _from_here(value: Any) -> Any:
    """Return plain data with its paths relative to the current folder, if they lie in it."""
    from pathlib import Path

    if isinstance(value, dict):
        return {key: _from_here(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_from_here(item) for item in value]
    if isinstance(value, Path):
        return str(value.relative_to(Path.cwd()) if value.is_relative_to(Path.cwd()) else value)
    return value


def _rows(facts: Mapping[str, Any]) -> Iterator[list[str]]:
    from photonpano.cli.wording import capture_words
    from photonpano.report.numbers import duration
    from photonpano.values import StreamInfo

    stream = StreamInfo(*(facts[key] for key in ("n_frames", "height", "width", "frame_rate_hz", "kind", "bit_depth")))
    size, speed_px, hot = facts["group_size"], facts["speed_px"], facts["hot_share"]
    yield ["source", facts["source"] + (f" ({facts['reason']})" if facts["reason"] else "")]
    yield ["capture", capture_words(stream)]
    yield ["duration", "unknown without frame_rate_hz" if facts["seconds"] is None else duration(facts["seconds"])]
    yield ["flux", f"{facts['flux']:.3g} photons per pixel per frame"]
    yield ["hot pixels", f"about {_percent(hot)}" if hot else "none"]
    yield ["speed", facts["speed_how"] if speed_px is None else f"{speed_px:.2g} px a frame ({facts['speed_how']})"]
    yield ["group size", "unknown" if size is None else f"{size}: {facts['group_size_reason']}"]


def _spec(facts: Mapping[str, Any]) -> str:
    from photonpano.registry.description import flow

    return "\n".join(f"{section}: {flow(value)}" for section, value in facts["spec"].items())


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"
