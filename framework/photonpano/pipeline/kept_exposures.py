"""Write the exposures of each level into a run folder, to look at and to compute with."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from photonpano.execution.context import Context
from photonpano.execution.threads import in_order
from photonpano.motion.loop import LevelResult
from photonpano.photometry import tone_mapped

FOLDER = "exposures"


def write_exposures(folder: Path, levels: Sequence[LevelResult], white_flux: float, context: Context) -> None:
    """Merge the exposures of each level again, as they were located, and write them.

    For each level, `exposures/level-1.npy` is (N, H, W) float32, `exposures/level-1.npz` describes its exposures, and
    `exposures/level-1-0012.png` is a picture of the one of number 12, from 0. Raises `OSError` if the disk is full.
    """
    (folder / FOLDER).mkdir()
    for result in levels:
        _write_level(folder / FOLDER, result, white_flux, context)


def _write_level(folder: Path, result: LevelResult, white_flux: float, context: Context) -> None:
    name, groups = f"level-{result.level.number}", result.groups
    digits = len(str(len(groups) - 1))
    exposures = in_order(result.exposures.merged, range(len(groups)), context.threads)
    title = f"exposures of level {result.level.number}"
    with (folder / f"{name}.npy").open("wb") as file, context.progress.stage(title, len(groups), "exposures") as advance:
        for number, exposure in enumerate(exposures):
            if not file.tell():
                head = {"descr": "<f4", "fortran_order": False, "shape": (len(groups), *exposure.flux.shape)}
                np.lib.format.write_array_header_1_0(file, head)
            file.write(np.ascontiguousarray(exposure.flux, "<f4").tobytes())
            _, picture = cv2.imencode(".png", tone_mapped(exposure.flux, white_flux))
            (folder / f"{name}-{number:0{digits}}.png").write_bytes(picture.tobytes())
            advance(1)
    instants = np.array([group.reference for group in groups])
    np.savez(
        folder / f"{name}.npz",
        allow_pickle=False,
        frames=np.array([[group.span.start, group.span.stop] for group in groups]),
        instants=instants,
        located=result.located.solution.located,
        homographies=result.trajectory.at(instants),
        scale=np.array(result.level.scale),
    )
