"""Name, convert, simulate, preview and measure captures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from photonpano.atomic import atomic_path
from photonpano.captures.picture_files import Picture, require_writable, write_pictures
from photonpano.captures.preview import Look, pictures, preview_spans, white_flux
from photonpano.captures.writing import write_packed
from photonpano.context import Progress, Quiet
from photonpano.corrections import hot_in_the_dark, measure_dark, write_dark
from photonpano.corrections.hot_pixels import THRESHOLD
from photonpano.errors import InputError, OutputError
from photonpano.pipeline.components import build_source
from photonpano.registry import Catalog
from photonpano.specs import Plan, parse_spec
from photonpano.threads import one_thread_inside, thread_count
from photonpano.values import BoolArray, FluxImage, StreamInfo

BRIGHT = 0.1
"""Median photons per frame above which a binary capture was not recorded with the lens covered."""


@dataclass(frozen=True, slots=True)
class WrittenCapture:
    """A packed .npy file, written by `convert` or `simulate`.

    Attributes:
        path: the file.
        truth: the file beside it with the true motion and scene, if the source knows them.
        info: the size and rate of the capture.
        n_masked: how many pixels the source masks; the file holds no mask.
        source: the section of a spec that reads the file.
    """

    path: Path
    truth: Path | None
    info: StreamInfo
    n_masked: int
    source: Mapping[str, Any]


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


@dataclass(frozen=True, slots=True, eq=False)
class DarkMeasurement:
    """Dark counts and hot pixels, measured by `dark`.

    Attributes:
        path: the file that was written.
        info: the size and rate of the capture.
        rates: (H, W) float32, dark counts per frame.
        valid: (H, W) bool, the pixels that are not masked.
        hot: (H, W) bool, the valid pixels that are hot.
        limit: the rate above which a pixel is hot.
        corrections: the corrections of a spec for this camera: those of the plan, then those that use the file.
        warnings: what is wrong with the capture, a sentence each.
    """

    path: Path
    info: StreamInfo
    rates: FluxImage
    valid: BoolArray
    hot: BoolArray
    limit: float
    corrections: Sequence[Any]
    warnings: tuple[str, ...]


def capture_plan(
    path: Path | str,
    keys: Mapping[str, Any] | None = None,
    *,
    source: str = "auto",
    corrections: Sequence[Any] = (),
    overrides: Sequence[str] = (),
    catalog: Catalog | None = None,
) -> Plan:
    """Make the plan of a capture without a spec.

    Args:
        path: the file or folder, relative to the current folder.
        keys: keys of its source, such as `{"frame_rate_hz": 96_800}`.
        source: the source that reads it; by default the one that recognises it.
        corrections: corrections, as in a spec.
        overrides: other values of the spec, such as `run.threads=2`.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        SpecError: no source recognises the capture, or a key or a correction is wrong.
    """
    section = {"use": source, "with": {"path": path, **(keys or {})}}
    return parse_spec({"version": 1, "source": section, "corrections": list(corrections)}, overrides=overrides, catalog=catalog)


def convert(
    plan: Plan, output: Path | str, progress: Progress | None = None, resumed: Callable[[int], object] | None = None
) -> WrittenCapture:
    """Write a capture of binary frames to a packed .npy file.

    When it is interrupted, the frames written so far stay in OUTPUT.part, and the next call continues from there.

    Args:
        plan: of the capture, from `capture_plan` or `load_spec`; its corrections are applied.
        output: the .npy file.
        progress: receives the stage; quiet by default.
        resumed: called with the number of frames that OUTPUT.part holds, if there is such a file; 0 if they belong to another
            capture and are written anew.

    Raises:
        InputError: the frames are not binary, or a correction changes sums of frames, which bits cannot hold.
        OutputError: the file cannot be written, or the disk is full.
    """
    return _write(plan, Path(output), progress, resumed or (lambda _: None))


def simulate(plan: Plan, output: Path | str, progress: Progress | None = None) -> WrittenCapture:
    """Write a capture to a packed .npy file, whole or not at all; a simulated one with its truth beside it.

    Args:
        plan: of the capture; its source may be any that gives binary frames.
        output: the .npy file.
        progress: receives the stage; quiet by default.

    Raises:
        InputError: as `convert`.
        OutputError: as `convert`.
    """
    return _write(plan, Path(output), progress, None)


def _write(plan: Plan, output: Path, progress: Progress | None, resumed: Callable[[int], object] | None) -> WrittenCapture:
    with build_source(plan) as source:
        info, n_masked = source.info, int((~source.valid).sum())
        with (progress or Quiet()).stage(f"writing {output.name}", info.n_frames, "frames") as advance:
            path, *truth = write_packed(source, output, advance, thread_count(plan.run.threads), resumed)
    keys: dict[str, Any] = {"path": str(path)}
    if info.frame_rate_hz is not None:
        keys["frame_rate_hz"] = info.frame_rate_hz
    if info.width % 8:
        keys["width"] = info.width
    return WrittenCapture(path, truth[0] if truth else None, info, n_masked, {"use": "packed-npy", "with": keys})


def preview(
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
    progress: Progress | None = None,
) -> Preview:
    """Merge frames into pictures without motion, to look at a capture.

    Args:
        plan: of the capture; its corrections are applied.
        output: a new folder for PNGs, or a file: .mp4 or .webp.
        group_size: frames of a picture.
        step: frames from the start of one picture to the next; by default `group_size`.
        quantile: the share of the pixels that is darker than white.
        white: the flux that is white, photons per pixel per frame; in place of `quantile`.
        srgb: whether levels follow the sRGB curve, or are proportional to the flux.
        label: whether frames and time are written below each picture.
        fps: pictures a second of a film.
        progress: receives the stage; quiet by default.

    Raises:
        OutputError: the pictures cannot be written, or a library that writes them is missing.
    """
    output = Path(output)
    with build_source(plan) as source, one_thread_inside():
        threads = thread_count(plan.run.threads)
        spans = preview_spans(source.info, group_size, step or group_size)
        require_writable(output, len(spans))
        look = Look(white_flux(source, spans, quantile, threads) if white is None else white, srgb, label)
        digits = len(str(source.info.n_frames))
        names = [f"frame_{span.start:0{digits}}" for span in spans]
        with (progress or Quiet()).stage(f"writing {output.name}", len(spans), "pictures") as advance:
            write_pictures(output, _counted(pictures(source, spans, look, threads), advance), names, fps)
        return Preview(output, len(spans), len(spans[0]), look.white_flux, source.info)


def _counted(made: Iterable[Picture], advance: Callable[[int], None]) -> Iterator[Picture]:
    for picture in made:
        yield picture
        advance(1)


def dark(plan: Plan, output: Path | str, threshold: float = THRESHOLD, progress: Progress | None = None) -> DarkMeasurement:
    """Measure dark counts and hot pixels in a capture that was recorded with the lens covered, and write them.

    Args:
        plan: of the capture; corrections that move pixels are applied.
        output: an .npz file for the dark counts, or a .npy file for the mask of the hot pixels.
        threshold: how far hot pixels stand out, in standard deviations.
        progress: receives the stage; quiet by default.

    Raises:
        InputError: all pixels are masked.
        OutputError: the file has another suffix, or cannot be written.
    """
    output = Path(output)
    if output.suffix not in (".npz", ".npy"):
        raise OutputError(f"cannot write {output}: dark counts are an .npz file, and a mask of hot pixels is a .npy file")
    with build_source(plan) as source:
        info, valid = source.info, source.valid
        if not valid.any():
            raise InputError("dark counts cannot be measured: all pixels of the capture are masked")
        with (progress or Quiet()).stage("dark counts", info.n_frames, "frames") as advance:
            measured = measure_dark(source, advance)
    hot, limit = hot_in_the_dark(measured, threshold, valid)
    with atomic_path(output) as temporary:
        if output.suffix == ".npz":
            write_dark(temporary, measured)
        else:
            np.save(temporary, hot)
    warnings = []
    if info.kind == "binary" and np.median(measured.rates[valid]) > BRIGHT:
        warnings.append(f"half of the pixels count more than {BRIGHT:g} photons per frame; was the lens covered?")
    uses = {"hot-pixels": "dark", "dark-counts": "dark"} if output.suffix == ".npz" else {"mask": "file"}
    corrections = [*plan.document["corrections"], *({name: {key: str(output)}} for name, key in uses.items())]
    return DarkMeasurement(output, info, measured.rates, valid, hot & valid, limit, corrections, tuple(warnings))
