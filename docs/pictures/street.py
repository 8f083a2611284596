"""The street: what goes in and what comes out, the exposures of three levels, and the errors between knots."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import picture_parts as draw
from harness import Compared, Study, groups, packed, simulator

from photonpano import FrameSpan, Group, StageContext, load_panorama, open_source, parse_spec

from . import finished
from .interpolation import interpolation

SHAKEN = {"kind": "scan", "rows": 2, "row_spacing_px": 150, "length_px": 1200, "centre": [900, 900], "shake": {"rms_px": 2.0}}
STREET = simulator(path=SHAKEN, flux=0.1, n_frames=10000)
"""The camera scans the street back and forth in a tenth of a second, with tremor, in low light."""
GROUP_SIZE = 125
LEVELS = ("one level", "two levels", "three levels")


def pictures(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield each picture with its name."""
    cube = study.capture("street", STREET)
    spec = packed(cube, resample=groups(GROUP_SIZE))
    runs = [finished(study, name, spec | {"levels": n}, cube) for n, name in enumerate(LEVELS, start=1)]
    yield "readme.png", readme(cube, runs[-1])
    yield "levels.png", levels(cube, runs)
    yield "interpolation.png", interpolation(cube)


def readme(cube: Path, run: Path) -> draw.Picture:
    """Return one frame, the sum of all frames, and the panorama of all frames."""
    with open_source(parse_spec(packed(cube))) as source:
        info, response = source.info, source.response
        frame = source.frames(FrameSpan(info.n_frames // 2, info.n_frames // 2 + 1))[0] * np.uint8(255)
        mean = source.counts(info.span).astype(np.float32) / info.n_frames
        average = response.flux(mean, info.n_frames)
    flux = load_panorama(run).flux
    white = draw.white_of(flux)
    n_frames = f"{info.n_frames:,}"
    above = {f"one frame of {n_frames}": frame, f"the {n_frames} frames, averaged": draw.picture(average, white)}
    panorama = draw.fitted(draw.picture(flux, white), 2 * info.width + draw.GAP)
    below = draw.labelled(panorama, f"the same {n_frames} frames, as a panorama")
    return np.vstack([draw.beside(draw.all_labelled(above)), below])


def levels(cube: Path, runs: list[Path]) -> draw.Picture:
    """Return the exposure of one group at each level, along the motion of the level before."""
    plan = parse_spec(packed(cube, resample=groups(GROUP_SIZE)))
    motions = {
        "level 1: no motion is known": None,
        "level 2: along the motion of level 1": Compared.of(runs[0], cube).motion,
        "level 3: along the motion of level 2": Compared.of(runs[1], cube).motion,
    }
    with open_source(plan) as source:
        choice = plan.levels[0].merge
        merger = choice.contribution.build(choice.config, StageContext(source.info, source.response))
        start = source.info.n_frames // 5
        group = Group(FrameSpan(start, start + GROUP_SIZE), start + (GROUP_SIZE - 1) / 2)
        fluxes = {label: merger.merge(source, group, motion, 1.0).flux for label, motion in motions.items()}
    return draw.beside(draw.all_labelled({label: draw.picture(flux[:, 60:380], 0.33) for label, flux in fluxes.items()}))
