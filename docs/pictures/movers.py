"""People who walk through the panorama of a turn: left out, merged with all else, and shown several times along their way."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import picture_parts as draw
from harness import Study, packed, simulator
from reality import BASE, CASES, FAST, TURN, people

from photonpano import render

from . import finished

WIDTH, SMALL = 900, 620
CROWD = simulator(**BASE, path=TURN, n_frames=6000, **people(0.25, **FAST))
PAIR = simulator(**BASE | {"flux": 0.4}, path=TURN, n_frames=6000, **people(0.12, number=2, speed_px=0.12))
REAL = ("people 40 fast, street 2", "boards 40", "people 14, boards 25, lamps, dark")
AS_IF = {"motion": {"model": "homography"}, "corrections": [], "light": "steady", "render": {"movers": "show"}}


def pictures(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield each picture with its name."""
    yield "what-moves.png", panoramas(study, "crowd", CROWD, "show", "hide")
    yield "action-shot.png", panoramas(study, "pair", PAIR, "3000", "action")


def real_world(study: Study) -> Iterator[tuple[str, draw.Picture]]:
    """Yield the picture of three captures in which much happens at once."""
    yield "real-world.png", draw.in_rows([row for name in REAL for row in as_if_and_as_it_is(study, name)])


def as_if_and_as_it_is(study: Study, name: str) -> Iterator[draw.Picture]:
    """Yield the panoramas of a capture: by one homography of all photons in steady light, and with all defaults."""
    path, others = CASES[name]
    cube = study.capture(name.replace(",", ""), simulator(**BASE | {"path": TURN | path} | others, n_frames=6000))
    for label, spec in (("as if", AS_IF), ("as it is", {})):
        run = finished(study, f"{name} {label}", packed(cube) | spec, cube)
        yield draw.fitted(cv2.imread(str(run / "panorama.png"), cv2.IMREAD_GRAYSCALE), SMALL)


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
