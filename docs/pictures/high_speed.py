"""The video of a conventional camera: a frame, and the panorama of all."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
import numpy as np
import tifffile
from picture_parts import labelled, picture, stacked

from photonpano import FrameSpan, open_source, parse_spec
from photonpano.captures.writing import truth_path

from .captures import finish, in_folder

if TYPE_CHECKING:
    from collections.abc import Iterator

    from picture_parts import Picture

    from photonpano import Plan

HIGH_SPEED = {
    "version": 1,
    "source": {
        "use": "camera-simulator",
        "with": {
            "path": {"kind": "pan", "length_px": 900, "angle_deg": 4, "shake": {"rms_px": 3.0, "frequencies_hz": [3, 5, 8]}},
            "flux": 1000,
            "sensor": {"exposure": 0.5},
        },
    },
}
"""A conventional camera pans along the street in 0.4 seconds."""


def pictures(folder: Path) -> Iterator[tuple[str, Picture]]:
    """Yield each picture with its name."""
    film = filmed(parse_spec(HIGH_SPEED), folder / "high-speed.mp4")
    source = {"use": "video", "with": {"path": str(film.absolute()), "frame_rate_hz": 500}}
    finish(parse_spec({"version": 1, "source": source}, output=in_folder(folder, "high speed")), "high speed", film)
    yield "high-speed.png", high_speed(folder, source)


def filmed(plan: Plan, path: Path) -> Path:
    """Write a simulated capture as a video, with its truth."""
    if not path.exists():
        with open_source(plan) as source, av.open(str(path), "w") as container:
            stream: Any = container.add_stream("libx264", rate=30)
            stream.height, stream.width, stream.pix_fmt = *source.info.frame_shape, "yuv420p"
            for frame in source.frames(source.info.span):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
            container.mux(stream.encode())
            np.savez(truth_path(path), **source.truth())
    return path


def high_speed(folder: Path, section: dict[str, Any]) -> Picture:
    """Return a frame of a video, and its panorama."""
    flux = tifffile.imread(in_folder(folder, "high speed") / "panorama.tiff")
    white = float(np.nanquantile(flux, 0.995))
    with open_source(parse_spec({"version": 1, "source": section})) as source:
        n_frames, middle = source.info.n_frames, source.info.n_frames // 2
        frame = source.response.flux(source.counts(FrameSpan(middle, middle + 1)).astype(np.float32), 1)
    panorama = picture(flux, white)
    beneath = np.full((frame.shape[0], panorama.shape[1]), 255, np.uint8)
    beneath[:, : frame.shape[1]] = picture(frame, white)
    return stacked([labelled(beneath, f"one frame of {n_frames}"), labelled(panorama, f"the {n_frames} frames, as a panorama")])
