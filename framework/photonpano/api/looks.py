"""Look at a capture before it is run: its size, brightness and speed, and its frames."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import typer

from photonpano.api.command import command, json_lines, warn
from photonpano.contracts.protocols import Source
from photonpano.corrections import HotPixels, without_still_pixels
from photonpano.errors import InputError
from photonpano.execution.context import Progress, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.files.folders import atomic_path, require_new
from photonpano.files.paths import Url
from photonpano.notebooks import facts
from photonpano.pipeline.components import build_source, foreseen_decisions
from photonpano.pipeline.obstacles import order_warning
from photonpano.pipeline.summary import require_photons, saturated_share, summarise
from photonpano.plugins.description import flow
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import capture_files
from photonpano.record.picture_files import advancing, require_writable, write_pictures
from photonpano.report.preview import Style, pictures, preview_spans, white_flux
from photonpano.specs import Plan, parse_spec
from photonpano.text import columns, counted, duration
from photonpano.values import CaptureSummary, StreamInfo

HOT_SHARE = 0.001  # fraction of hot pixels above which a mask is recommended
STANDING_SHARE = 0.5  # if more of the frame is static than this, `corrections: auto` masks nothing
SATURATED_SHARE = 0.01  # fraction of pixels saturated in every frame above which less light is recommended


@dataclass(frozen=True, slots=True)
class CaptureInfo:
    """What a capture is and what its frames show; `photonpano info --json` prints these fields.

    Attributes:
        source: the source that reads it.
        reason: why this source was chosen; None if the spec names it.
        n_frames: number of frames.
        height: rows of a frame.
        width: columns of a frame.
        kind: "binary" or "intensity".
        bit_depth: bits of a pixel.
        frame_rate_hz: frames per second; None if unknown.
        seconds: duration; None if the frame rate is unknown.
        flux: mean flux, photons per pixel per frame.
        speed_px: speed of the image where it is fast, px per frame; None if it cannot be measured.
        speed_how: how the speed was measured, or why not.
        unused_share: share of the pixels that are masked.
        hot_share: share of the other pixels that the correction `hot-pixels` would mask.
        still_share: share of them that the correction `still-pixels` would mask, as a run with `corrections: auto` does.
        standing_share: share of the frame that stands still, of the parts that show motion or rest.
        still_how: what stands still, or why nothing is masked.
        saturated_share: share of them that have their highest value in every frame looked at.
        group_size: frames of a group that `group_size: auto` chooses; None if the capture is too short.
        group_size_reason: the reason for that choice.
        warnings: what to correct before a run, a sentence each.
        spec: a spec to start from, as plain data; its paths are relative to the current folder where they lie in it.
    """

    source: str
    reason: str | None
    n_frames: int
    height: int
    width: int
    kind: Literal["binary", "intensity"]
    bit_depth: int
    frame_rate_hz: float | None
    seconds: float | None
    flux: float
    speed_px: float | None
    speed_how: str
    unused_share: float
    hot_share: float
    still_share: float
    standing_share: float
    still_how: str
    saturated_share: float
    group_size: int | None
    group_size_reason: str
    warnings: tuple[str, ...]
    spec: dict[str, Any]

    @property
    def stream(self) -> StreamInfo:
        """Frames, size and rate as one value."""
        return StreamInfo(self.n_frames, self.height, self.width, self.frame_rate_hz, self.kind, self.bit_depth)

    @property
    def spec_yaml(self) -> str:
        """The spec to start from as YAML."""
        return "\n".join(f"{section}: {flow(value)}" for section, value in self.spec.items())

    def rows(self) -> list[tuple[str, str]]:
        """Return what was found, in words: pairs of a name and what it is."""
        speed, size = self.speed_px, self.group_size
        return [
            ("source", self.source + (f" ({self.reason})" if self.reason else "")),
            ("capture", str(self.stream)),
            ("duration", "unknown without frame_rate_hz" if self.seconds is None else duration(self.seconds)),
            ("flux", f"{self.flux:.3g} photons per pixel per frame"),
            ("hot pixels", f"about {percent(self.hot_share)}" if self.hot_share else "none"),
            ("still", self.still_how),
            ("speed", self.speed_how if speed is None else f"{speed:.2g} px per frame ({self.speed_how})"),
            ("group size", "unknown" if size is None else f"{size}: {self.group_size_reason}"),
        ]

    def _repr_html_(self) -> str:
        return facts([*self.rows(), *(("warning", each) for each in self.warnings)])


def _lines_of_info(found: CaptureInfo, *, as_json: bool = False) -> Iterator[str]:
    if as_json:
        yield from json_lines(asdict(found))
        return
    yield columns(found.rows())
    for warning in found.warnings:
        warn(warning)
    yield f"\nA spec to start from:\n\n{found.spec_yaml}"


@command("cube.npy --with frame_rate_hz=96800 --write scan.yaml", _lines_of_info, plan="capture")
def info(
    plan: Plan, catalog: Catalog | None = None, *, write: Path | str | None = None, overwrite: bool = False
) -> CaptureInfo:
    """Summarise a capture: size, brightness and speed, and a spec to start from.

    Reads some thousands of frames, spread over the capture.

    Args:
        plan: of the capture, from `capture_plan` or `load_spec`; its corrections are applied.
        catalog: what can be chosen; by default what the installed plugins offer.
        write: a file for the spec to start from.
        overwrite: replace the file that is there under this name.

    Raises:
        InputError: the capture cannot be read.
        OutputError: the file is there already, or cannot be written.
    """
    if write is not None:
        require_new(Path(write), overwrite)
    with build_source(plan) as read:
        marked = without_still_pixels(read)
        source = marked if plan.corrects_itself else read
        with one_thread_inside():
            summary = summarise(source, thread_count(plan.run.threads))
        stream, rate = source.info, source.info.frame_rate_hz
        size, reason = _group_size(plan, source, summary, catalog)
        with build_source(replace(plan, corrections=(*plan.corrections, HotPixels()))) as other:
            hot = read.valid & ~other.valid
        still = read.valid & ~marked.valid
        folder = Path.cwd() if write is None else Path(write).absolute().parent
        keys = _relative(plan.source.config.model_dump(exclude_defaults=True), folder)
        spec: dict[str, Any] = {"version": 1, "source": {"use": plan.source.contribution.name, "with": keys}}
        if not plan.corrects_itself:
            spec["corrections"] = plan.document["corrections"]
        found = CaptureInfo(
            source=plan.source.contribution.name,
            reason=None if plan.recognised is None else plan.recognised.reason,
            n_frames=stream.n_frames,
            height=stream.height,
            width=stream.width,
            kind=stream.kind,
            bit_depth=stream.bit_depth,
            frame_rate_hz=rate,
            seconds=None if rate is None else stream.n_frames / rate,
            flux=summary.flux,
            speed_px=summary.speed_px,
            speed_how=summary.how,
            unused_share=1 - float(read.valid.mean()),
            hot_share=float(hot[read.valid].mean()),
            still_share=float(still[read.valid].mean()),
            standing_share=marked.still.share,
            still_how=marked.still.how,
            saturated_share=saturated_share(source),
            group_size=size,
            group_size_reason=reason,
            warnings=(),
            spec=spec,
        )
        if write is not None:
            with atomic_path(Path(write)) as temporary:
                temporary.write_text(found.spec_yaml + "\n", encoding="utf-8")
        return replace(found, warnings=tuple(_warnings(source, found, float(hot[source.valid].mean()))))


def percent(share: float) -> str:
    """Write a share as a percentage of two digits."""
    return f"{100 * share:.2g} %"


def _group_size(plan: Plan, source: Source, summary: CaptureSummary, catalog: Catalog | None) -> tuple[int | None, str]:
    """Return the group size that `auto` chooses, whatever the spec says, and the reason."""
    source_section = {"use": plan.source.contribution.name, "with": plan.source.config.model_dump(by_alias=True)}
    spec = {"version": 1, "source": source_section, "resample": {"use": "midpoint"}, "levels": 1}
    try:
        (chosen,) = foreseen_decisions(parse_spec(spec, catalog=catalog), source, summary)
    except InputError as error:
        return None, str(error)
    return int(chosen.value), chosen.reason


def _warnings(source: Source, found: CaptureInfo, hot_left: float) -> Iterator[str]:
    try:
        require_photons(source)
    except InputError as error:
        yield str(error)
        return
    if warning := order_warning(source):
        yield warning
    if hot_left > HOT_SHARE:
        yield f"about {percent(hot_left)} of the pixels are hot; mask them with the correction hot-pixels"
    if found.standing_share > STANDING_SHARE:
        share = f"{found.standing_share:.0%}"
        yield f"{share} of the frame stands still; if the camera moved, mask what is not the scene with the correction mask"
    if found.saturated_share > SATURATED_SHARE:
        share = percent(found.saturated_share)
        yield f"{share} of the pixels have their highest value in every frame, so that their flux is unknown; expose less"
    if found.group_size is None:
        yield found.group_size_reason


def _relative(value: Any, folder: Path) -> Any:
    """Return plain data with its paths relative to a folder, where they lie in it."""
    if isinstance(value, dict):
        return {key: _relative(item, folder) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_relative(item, folder) for item in value]
    if isinstance(value, Path):
        return str(value.relative_to(folder) if value.is_relative_to(folder) else value)
    if isinstance(value, Url):
        return str(value)
    return value


@dataclass(frozen=True, slots=True)
class Preview:
    """Pictures of a capture, written by `preview`.

    Attributes:
        path: the folder or film.
        n_pictures: how many pictures it holds.
        group_size: frames of each picture.
        white_flux: the flux that is white, photons per pixel per frame.
        info: the size and rate of the capture.
    """

    path: Path
    n_pictures: int
    group_size: int
    white_flux: float
    info: StreamInfo


def _lines_of_preview(made: Preview) -> Iterator[str]:
    yield f"{made.path}: {counted(made.n_pictures, 'picture')} of {made.info}, {made.group_size} frames each"
    yield f"white is {made.white_flux:.4g} photons per pixel per frame"


@command(
    "cube.npy --output look.mp4 --group-size 500",
    _lines_of_preview,
    plan="capture",
    output=typer.Option("--output", "-o", metavar="OUT"),
    group_size=typer.Option(min=1, metavar="N"),
    step=typer.Option(min=1, metavar="N"),
    quantile=typer.Option(min=0, max=1, metavar="Q"),
    white=typer.Option(min=1e-9, metavar="FLUX"),
    srgb=typer.Option("--srgb/--linear"),
    label=typer.Option("--label/--no-label"),
    fps=typer.Option(min=0.1, max=240, metavar="HZ"),
)
def preview(  # noqa: PLR0913
    plan: Plan,
    output: Path | str,
    group_size: int = 256,
    step: int | None = None,
    *,
    quantile: float = 0.995,
    white: float | None = None,
    srgb: bool = True,
    label: bool = True,
    fps: float = 24,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Preview:
    """Merge frames into pictures without motion, to look at a capture.

    White is the same flux in all pictures, so that their brightness can be compared.

    Args:
        plan: of the capture; its corrections are applied.
        output: a folder for PNGs, or an .mp4, .webp or .gif file.
        group_size: frames of a picture.
        step: frames from the start of one picture to the next; by default `group_size`.
        quantile: the share of the pixels that are darker than white.
        white: the flux that is white, in photons per pixel per frame; in place of `quantile`.
        srgb: sRGB levels for screens, or levels proportional to the flux.
        label: write the frame numbers and the time below each picture.
        fps: pictures per second of a film.
        overwrite: replace the pictures that are there under this name.
        progress: receives the stage; by default, bars in a notebook and nothing elsewhere.

    Raises:
        OutputError: the pictures are there already, or cannot be written, or a library that writes them is missing.
    """
    output = Path(output)
    require_new(output, overwrite, capture_files(plan))
    with build_source(plan) as source, one_thread_inside():
        threads = thread_count(plan.run.threads)
        spans = preview_spans(source.info, group_size, step or group_size)
        require_writable(output, len(spans))
        style = Style(white_flux(source, spans, quantile, threads) if white is None else white, srgb, label)
        digits = len(str(source.info.n_frames))
        names = [f"frame_{span.start:0{digits}}" for span in spans]
        with usual(progress).stage(f"writing {output.name}", len(spans), "pictures") as advance:
            write_pictures(output, advancing(pictures(source, spans, style, threads), advance), names, fps)
        return Preview(output, len(spans), len(spans[0]), style.white_flux, source.info)
