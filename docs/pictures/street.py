"""The street: what goes in and what comes out, the exposures of three levels, and the errors between knots."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import tifffile
from picture_parts import GAP, beside, labelled, picture, stacked

from photonpano import FrameSpan, Group, StageContext, open_source, parse_spec

from .captures import finish, in_folder, motion, spec_of, written
from .interpolation import interpolation

if TYPE_CHECKING:
    from collections.abc import Iterator

    from picture_parts import Picture

STREET = {
    "version": 1,
    "source": {
        "use": "simulator",
        "with": {
            "path": {
                "kind": "scan",
                "rows": 2,
                "row_spacing_px": 150,
                "length_px": 1200,
                "centre": [900, 900],
                "shake": {"rms_px": 2.0},
            },
            "flux": 0.1,
            "n_frames": 10000,
        },
    },
}
"""The camera scans the street back and forth in a tenth of a second, with tremor, in low light."""
GROUP_SIZE = 125
LEVELS = ("one level", "two levels", "three levels")


def pictures(folder: Path) -> Iterator[tuple[str, Picture]]:
    """Yield each picture with its name."""
    cube = written(parse_spec(STREET), folder / "street.npy")
    for number, name in enumerate(LEVELS, start=1):
        finish(parse_spec(street_spec(cube), overrides=[f"levels={number}"], output=in_folder(folder, name)), name, cube)
    yield "readme.png", readme(folder, cube)
    yield "levels.png", levels(folder, cube)
    yield "interpolation.png", interpolation(cube)


def street_spec(cube: Path) -> dict[str, Any]:
    """Return the spec of the street."""
    return spec_of(cube, resample={"use": "midpoint", "with": {"group_size": GROUP_SIZE}})


def readme(folder: Path, cube: Path) -> Picture:
    """Return one frame, the sum of all frames, and the panorama of all frames."""
    with open_source(parse_spec(street_spec(cube))) as source:
        info, response = source.info, source.response
        frame = source.frames(FrameSpan(info.n_frames // 2, info.n_frames // 2 + 1))[0] * np.uint8(255)
        mean = source.counts(info.span).astype(np.float32) / info.n_frames
        average = response.flux(mean, info.n_frames)
    flux = tifffile.imread(in_folder(folder, LEVELS[-1]) / "panorama.tiff")
    white = float(np.nanquantile(flux, 0.995))
    width = 2 * info.width + GAP
    panorama = picture(flux, white)
    panorama = cv2.resize(panorama, (width, round(panorama.shape[0] * width / panorama.shape[1])), interpolation=cv2.INTER_AREA)
    n_frames = f"{info.n_frames:,}"
    return stacked(
        [
            beside(
                [
                    labelled(frame, f"one frame of {n_frames}"),
                    labelled(picture(average, white), f"the {n_frames} frames, averaged"),
                ]
            ),
            labelled(panorama.astype(np.uint8), f"the same {n_frames} frames, as a panorama"),
        ]
    )


def levels(folder: Path, cube: Path) -> Picture:
    """Return the exposure of one group at each level, along the motion of the level before."""
    plan = parse_spec(street_spec(cube))
    known = {
        "level 1: no motion is known": None,
        "level 2: along the motion of level 1": in_folder(folder, "one level"),
        "level 3: along the motion of level 2": in_folder(folder, "two levels"),
    }
    with open_source(plan) as source:
        choice = plan.levels[0].merge
        merger = choice.contribution.build(choice.config, StageContext(source.info, source.response))
        start = source.info.n_frames // 5
        group = Group(FrameSpan(start, start + GROUP_SIZE), start + (GROUP_SIZE - 1) / 2)
        pictures = []
        for label, directory in known.items():
            trajectory = None if directory is None else motion(directory)
            flux = merger.merge(source, group, trajectory, 1.0).flux
            pictures.append(labelled(picture(flux[:, 60:380], 0.33), label))
    return beside(pictures)
