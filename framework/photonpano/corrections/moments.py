"""Show what moves in a panorama as it was at some moments."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.capture import capture_of, with_background
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.corrections.lighting.gains import scene_canvas
from photonpano.corrections.movers import places_of_cells
from photonpano.geometry import Camera
from photonpano.values import CELL_PX, Background, BoolArray, Decision

_SIZES = 1.6  # largest ratio of the size of a mover that is shown several times to the usual one, and its inverse
_BORDER = 2.0  # largest square of the length of its cut by the border of a frame, in areas
_APART = np.ones((13, 13), np.uint8)  # half cells around a mover that is shown several times, without others
_BESIDE = np.ones((5, 5), np.uint8)  # half cells that a cell covers, and those beside it
_BORDERS = np.ones((7, 7), np.uint8)  # that, and the half cells at the borders of frames, which others may not see
_MOVED, _LONGEST = 0.03, 8  # share of a mover that leaves its place while it is shown, and most instants, to either side


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """Where the cells of frames lie in the scene, at the S instants of a background."""

    background: Background
    shape: tuple[int, int]  # of the scene, in half cells
    places: NDArray[np.intp]  # (S, h, w, 2), row and column of half cells

    def painted(self, instant: int, cells: BoolArray) -> NDArray[np.uint8]:
        """Return the half cells of the scene that cells show, and those beside them, as 1: (H, W)."""
        image = np.zeros(self.shape, np.uint8)
        image[tuple(self.places[instant][cells].T)] = 1
        return np.asarray(cv2.dilate(image, _BESIDE))

    def never_seen(self) -> float:
        """Return the share of the scene whose background no frame shows."""
        seen, shown = (
            cv2.erode(np.bitwise_or.reduce([self.painted(index, each) for index, each in enumerate(cells)]), _BESIDE[1:, 1:])
            for cells in (self.background.filled, self.background.shown)
        )
        return float((seen > shown).sum() / max(seen.sum(), 1))

    def with_movers(self, moments: Iterable[tuple[int, BoolArray]]) -> tuple[Background, list[int]]:
        """Show the movers that hide some cells at some instants, where no others are near; return the instants, too."""
        times, reaches = (np.zeros(self.shape, np.intp) for _ in range(2))
        for instant, cells in moments:
            reach, image = self._hidden_for(instant, cells)
            if not times[cv2.dilate(image, _APART) > 0].any():
                times[image > 0], reaches[image > 0] = instant + 1, reach
        there, reach_there = (image[tuple(np.moveaxis(self.places, -1, 0))] for image in (times, reaches))
        near = np.abs(there - 1 - np.arange(len(there))[:, None, None]) <= reach_there
        shown = np.where(there == 0, self.background.filled, near)
        return replace(self.background, shown=shown), np.unique(times[times > 0] - 1).tolist()

    def _hidden_for(self, instant: int, cells: BoolArray) -> tuple[int, NDArray[np.uint8]]:
        """Return for how many instants to either side what hides some cells hardly moves, and where all of these see."""
        image, hidden = self.painted(instant, cells), ~self.background.filled
        stays = []
        for away in (1, _LONGEST):
            both = [each for each in (instant - away, instant + away) if 0 <= each < len(hidden)] or [instant]
            stays.append(float(np.mean([self.painted(each, hidden[each])[image > 0] for each in both])))
        # A frame shows what both instants next to it show, so that no frame would be left of a single instant.
        reach = int(np.clip(_MOVED * (_LONGEST - 1) / max(stays[0] - stays[1], 1e-6), 1, _LONGEST))
        for each in range(max(instant - reach, 0), min(instant + reach + 1, len(hidden))):
            image &= cv2.erode(self.painted(each, np.ones_like(cells)), _BORDERS).astype(np.uint8)
        return reach, image


def showing(
    source: Source, trajectory: Trajectory, camera: Camera | None, movers: Literal["hide", "show", "action"] | int
) -> tuple[Source, list[Decision], float]:
    """Return a capture with the movers that a panorama shows, decisions on them, and the share whose background was never seen.

    Args:
        source: the capture, without what hides its background; as it is, if nothing does.
        trajectory: its motion.
        camera: that turns; None if the motion is any.
        movers: hide or show them, or show them as they were at a frame, or, with action, several times along their way.
    """
    background = capture_of(source).background
    if background is None:
        return with_background(source, None), [], 0.0
    motions = trajectory.at(background.instants)
    frames = scene_canvas(camera, motions, source.info.frame_shape, 2 / CELL_PX)
    margin = max(background.shown.shape[1:])  # half a frame, for lenses
    canvas = frames.part(-margin, -margin, frames.height + 2 * margin, frames.width + 2 * margin)
    places = np.array([*places_of_cells(source, canvas, motions)])[..., ::-1]
    scene = _Scene(background, canvas.shape, np.clip(places.round(), 0, np.subtract(canvas.shape, 1)).astype(np.intp))
    decisions, share = list[Decision](), round(scene.never_seen(), 3)
    if share:
        instead = "" if movers == "show" else "; what differs least from the usual is shown there"
        said = f"the background of {share:.1%} of the panorama was never seen{instead}"
        decisions.append(Decision("background_never_seen", share, said))
    if movers == "show":
        return with_background(source, None), decisions, share
    hidden, moments = ~background.filled, list[tuple[int, BoolArray]]()
    if movers != "hide":
        nearest = 0 if movers == "action" else int(np.abs(background.instants - movers).argmin())
        moments = _whole_movers(hidden) if movers == "action" else [(nearest, hidden[nearest])]
    shown, times = scene.with_movers(moments)
    if movers != "hide":
        at = ", ".join(f"{background.instants[each]:.0f}" for each in times) or "none"
        decisions.append(Decision("shown_movers", len(times), f"what moves is shown as it was around frames: {at}"))
    return with_background(source, shown), decisions, share


def _whole_movers(hidden: BoolArray) -> list[tuple[int, BoolArray]]:
    """Return patches of about the usual size, with their instants: neither parts of movers, nor several at once."""
    found = []
    for instant, cells in enumerate(hidden.astype(np.uint8)):
        number, labels = cv2.connectedComponents(cells)
        for patch in (labels == label for label in range(1, number)):
            border = max(int(each.sum()) for each in (patch[0], patch[-1], patch[:, 0], patch[:, -1]))
            if border**2 <= _BORDER * patch.sum():
                found.append((instant, patch))
    sizes = np.array([patch.sum() for _, patch in found], int)
    usual = np.median(sizes.repeat(sizes)) if found else 0  # of most of what is hidden
    return [each for each, size in zip(found, sizes, strict=True) if usual / _SIZES < size < usual * _SIZES]
