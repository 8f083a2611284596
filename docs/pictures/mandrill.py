"""The picture of a real capture: a binary frame, the average of all frames, and the panorama."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import tifffile
from picture_parts import beside, labelled, picture

from photonpano import FrameSpan, load_spec, open_source, run

if TYPE_CHECKING:
    from collections.abc import Iterator

    from picture_parts import Picture

SPEC = Path(__file__).parents[2] / "examples" / "pipelines" / "mandrill.yaml"


def pictures(folder: Path) -> Iterator[tuple[str, Picture]]:
    """Yield each picture with its name."""
    yield "mandrill.png", mandrill(folder / "mandrill")


def mandrill(folder: Path) -> Picture:
    """Return the picture, and print how the picture turns; what the run folder holds is used again."""
    plan = load_spec(SPEC, output=folder)
    if not (folder / "run.json").exists():
        print(next(each for each in run(plan).record["decisions"] if each["what"] == "start"))
    with open_source(plan) as source:
        n_frames = source.info.n_frames
        frame = source.frames(FrameSpan(n_frames // 2, n_frames // 2 + 1))[0] * np.uint8(255)
        average = source.counts(source.info.span) / np.float32(n_frames)
    parts = frame, shown(average), shown(tifffile.imread(folder / "panorama.tiff"))
    labels = f"one frame of {n_frames}", f"the {n_frames} frames, averaged", f"the same {n_frames} frames, as a panorama"
    return beside([labelled(part, label) for part, label in zip(parts, labels, strict=True)])


def shown(flux: np.ndarray) -> Picture:
    """Return flux as 8-bit sRGB, up to its own white."""
    return picture(np.nan_to_num(flux).astype(np.float32), float(np.nanquantile(flux, 0.995)))
