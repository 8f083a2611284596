"""Diagnosis of exposures that could not be located: which pairs failed, with which numbers, and what to try."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import LocationError
from photonpano.geometry import corners
from photonpano.motion.graph import GraphSolution
from photonpano.photometry import signal_to_noise
from photonpano.text import listed
from photonpano.values import BoolArray, Edge, FrameSpan, Group, NotLocated, VirtualExposure, true_spans

TOLERATED_RUN = 2  # lost exposures in a row across which the motion is interpolated
# Signal-to-noise ratios: below the first the likely cause is darkness, above the second blur; texture may lack at any.
_NOISY, _CLEAR = 0.25, 2.0
_NOTHING = 0.01  # signal-to-noise ratio below which there is hardly any signal
_FAR = 1e9  # numbers of a homography from this on map a frame to infinity
_SHOWN = 6  # most pairs, spans or parts that a message lists
# Frames of 24x24 and 8x512 px were located, and none of 16x16, 4x256 and 1x512.
_FEWEST_ROWS, _FEWEST_PIXELS = 8, 500


@dataclass(frozen=True, slots=True)
class Contrast:
    """Contrast of an exposure."""

    signal_to_noise: float  # standard deviation of the scene over that of a pixel's noise, see `photonpano.photometry`
    blank: str | None = None  # why nothing can be seen in it; None if something can


class UntiedError(LocationError):
    """Too many exposures of a level are not tied to the others."""

    def __init__(  # noqa: PLR0917
        self,
        message: str,
        level: int,
        groups: Sequence[Group],
        edges: Sequence[Edge],
        parts: NDArray[np.integer],
        signal_to_noise: float | None,
        merged: Callable[[int], VirtualExposure] | None,
    ) -> None:
        super().__init__(message)
        self.level, self.groups, self.edges = level, groups, edges
        self.parts = parts  # (N,) number of the connected component of each exposure, 0 for the largest
        self.merged = merged  # returns an exposure by its number; None where they cannot be merged again
        self.signal_to_noise = signal_to_noise  # median of those that are lost; None if nothing can be seen in any

    @property
    def blurred(self) -> bool:
        """Whether motion within the exposures may be the cause, rather than darkness."""
        return self.signal_to_noise is not None and self.signal_to_noise >= _NOISY


def contrast_of(exposure: VirtualExposure) -> Contrast:
    """Measure the contrast of an exposure."""
    longest = exposure.weight.max()
    if longest == 0:
        return Contrast(0.0, "no pixel was seen")
    # Unlike max and min, these skip NaN.
    if np.fmax.reduce(exposure.flux, axis=None) <= 0:
        return Contrast(0.0, "no pixel detected a photon; is the shutter closed, or is it the wrong file?")
    darkest = exposure.response.mean_count(np.fmin.reduce(exposure.flux, axis=None, keepdims=True))
    brightest = exposure.response.mean_count(np.array([np.inf], np.float32))
    # For a pixel lit in every frame, half a frame is taken to be dark; with one dark frame, the difference is larger.
    if brightest.item() - darkest.item() < 0.75 / longest:
        return Contrast(0.0, "every pixel is saturated, so that its flux is unknown; use a smaller aperture")
    return Contrast(signal_to_noise(exposure))


def require_tied(  # noqa: PLR0913
    level: int,
    groups: Sequence[Group],
    edges: Sequence[Edge],
    *,
    parts: NDArray[np.integer],
    contrasts: Mapping[int, Contrast],
    disconnected: Literal["error", "largest"],
    merged: Callable[[int], VirtualExposure] | None = None,
    foreseen: BoolArray | None = None,
    frame_shape: tuple[int, int] | None = None,
) -> None:
    """Raise an `UntiedError` for a level where too many exposures are not tied to the others.

    Up to two exposures in a row may be lost, since the motion is interpolated across them. A longer run is an error, unless
    `disconnected` is "largest", or the level before has lost these frames, too: their exposures are not `foreseen` (N,). Fewer
    than two located exposures are always an error. `parts` (N,) numbers the connected component of each exposure, 0 for the
    largest; `merged` returns an exposure to whoever looks at those that are lost.
    """
    tied = parts == 0
    if len(groups) == 1:
        return
    runs = _runs(groups, ~tied)
    lost = [run for run in true_spans(~tied) if foreseen is None or foreseen[run.start : run.stop].any()]
    longest = max(map(len, lost), default=0)
    if tied.sum() >= 2 and (longest <= TOLERATED_RUN or disconnected == "largest"):
        return
    reasons = [
        f"  {groups[edge.moving]} onto {groups[edge.fixed]}: {edge.motion.reason}"
        for edge in edges
        if isinstance(edge.motion, NotLocated)
    ]
    more = [f"  ... and {len(reasons) - _SHOWN} more"] if len(reasons) > _SHOWN else []
    lost_contrasts = [contrasts[int(index)] for index in np.flatnonzero(~tied)] if not tied.all() else list(contrasts.values())
    ratios = [contrast.signal_to_noise for contrast in lost_contrasts if not contrast.blank]
    ratio = float(np.median(ratios)) if ratios else None
    lines = [*reasons[:_SHOWN], *more, *([] if ratio is None else _advice(groups, ratio))]
    if tied.sum() < 2:
        lines = [f"level {level}: none of the {len(edges)} pairs of exposures could be located", *lines]
    else:
        spans = [_frames(run) for run in runs[:_SHOWN]] + ([f"{len(runs) - _SHOWN} more spans"] if len(runs) > _SHOWN else [])
        lines = [
            f"level {level}: {len(reasons)} of {len(edges)} pairs of exposures could not be located, "
            f"so that {listed(spans)} cannot be tied to the rest",
            f"Parts that are tied together: {_tied_together(groups, parts)}.",
            *lines,
            "To go on with the largest part alone, set graph.disconnected to largest.",
        ]
    if frame_shape is not None and (min(frame_shape) < _FEWEST_ROWS or np.prod(frame_shape) < _FEWEST_PIXELS):
        height, width = frame_shape
        small = f"Frames of {height}x{width} px are too small for most scenes: use {_FEWEST_ROWS} rows and columns or more, and"
        lines = [lines[0], f"{small} {_FEWEST_PIXELS} pixels or more."]
    raise UntiedError(
        message="\n".join(lines), level=level, groups=groups, edges=edges, parts=parts, signal_to_noise=ratio, merged=merged
    )


def tell_attempt(error: LocationError, what: str, failure: Exception) -> None:
    """Add to an error what was tried in vain."""
    first_clause = str(failure).splitlines()[0].split("; ")[0].removeprefix("motion.start: ")
    error.args = (f"{error}\n{what} was tried, too: {first_clause}",)


@contextmanager
def solving(level: int) -> Iterator[None]:
    """Raise a `LocationError` if the motion graph cannot be solved in the block: homographies are singular, or not finite."""
    try:
        yield
    except (np.linalg.LinAlgError, ValueError, RuntimeError) as error:
        raise LocationError(
            f"level {level}: the located pairs contradict each other so much that no homographies fit them ({error}); try "
            "other groups, or another locator"
        ) from error


def require_in_front(
    level: int, groups: Sequence[Group], solution: GraphSolution, frame_shape: tuple[int, int], cause: BaseException
) -> None:
    """Raise a `LocationError` from its cause if exposures reach the horizon of the plane that they are located in."""
    points = corners(frame_shape)
    with np.errstate(all="ignore"):
        depths = solution.homographies[:, 2:, :2] @ points.T + solution.homographies[:, 2:, 2:]
        beyond = solution.located & ~((depths > 0).all(axis=(1, 2)) & (np.abs(solution.homographies) < _FAR).all(axis=(1, 2)))
    if runs := _runs(groups, beyond):
        lost = [_frames(run) for run in runs[:_SHOWN]]
        raise LocationError(
            f"level {level}: {listed(lost)} reach the horizon of the plane that all exposures are located in: pairs are wrong "
            "(try other groups or another locator), or the camera turns too far for one plane (write motion: {model: rotation})"
        ) from cause


def _tied_together(groups: Sequence[Group], parts: NDArray[np.integer]) -> str:
    """List the frames of each part of at least two exposures, the largest part first."""
    sizes = np.bincount(parts)
    named = [
        " with ".join(_frames(run) for run in _runs(groups, parts == part)) for part in np.flatnonzero(sizes >= 2)[: _SHOWN + 1]
    ]
    return "; ".join(named[:_SHOWN]) + ("; and others" if len(named) > _SHOWN else "")


def _advice(groups: Sequence[Group], ratio: float) -> list[str]:
    size = int(np.median([len(group.span) for group in groups]))
    varies = "does not stand out from" if ratio < _NOTHING else f"varies {ratio:.2g} times as much as"
    seen = f"In these exposures of {size} frames the scene {varies} a pixel's photon noise"
    if ratio < _NOISY:
        return [
            f"{seen}: either they are too dark (try larger groups, such as resample.with.group_size={2 * size}), "
            "or the scene has no texture there."
        ]
    if ratio < _CLEAR:
        return [
            f"{seen}: either motion blurs them (try smaller groups, such as resample.with.group_size={max(1, size // 2)}), "
            f"or they are too dark for what texture there is (try larger ones, such as resample.with.group_size={2 * size})."
        ]
    return [
        f"{seen}, so darkness is not the cause: either motion blurs them (try smaller groups, such as "
        f"resample.with.group_size={max(1, size // 2)}), or the scene has no texture there."
    ]


def _runs(groups: Sequence[Group], flags: BoolArray) -> list[Sequence[Group]]:
    """Return the runs of groups whose flag is set."""
    return [groups[run.start : run.stop] for run in true_spans(flags)]


def _frames(groups: Sequence[Group]) -> str:
    return str(FrameSpan(groups[0].span.start, groups[-1].span.stop))
