"""People who walk through the panorama of a turn: left out, merged with all else, and shown several times along their way."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import picture_parts as draw
from harness import Study, packed, simulator
from reality import BASE, FAST, TURN, people

from photonpano import render

from . import finished

WIDTH = 900
CROWD = simulator(**BASE, path=TURN, n_frames=6000, **people(0.25, **FAST))
PAIR = simulator(**BASE | {"flux": 0.4}, path=TURN, n_frames=6000, **people(0.12, number=2, speed_px=0.12))


def pictures(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield each picture with its name."""
    yield "what-moves.png", panoramas(study, "crowd", CROWD, "show", "hide")
    yield "action-shot.png", panoramas(study, "pair", PAIR, "3000", "action")


def panoramas(study: Study, name: str, spec: dict[str, object], *movers: str) -> draw.Picture:
    """Return panoramas of a run with some values of `render.movers`, below each other."""
    cube = study.capture(name, spec)
    run, rows = finished(study, name, packed(cube), cube), []
    for each in movers:
        folder = study.folder / f"{name}-{each}"
        if not folder.exists():
            render(run, folder, [f"render.movers={each}"])
        rows.append(draw.fitted(cv2.imread(str(folder / "panorama.png"), cv2.IMREAD_GRAYSCALE), WIDTH))
    return draw.in_rows(rows)
