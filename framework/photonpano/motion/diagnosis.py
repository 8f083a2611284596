"""Why exposures could not be located, in words: what failed, with which numbers, and what to try."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photonpano.errors import LocationError
from photonpano.photometry import signal_to_noise
from photonpano.values import BoolArray, Edge, FrameSpan, Group, NotLocated, VirtualExposure, true_spans

TOLERATED_RUN = 2
"""So many exposures in a row may be lost: the motion is interpolated across them."""
_NOISY, _CLEAR = 0.25, 2.0
"""Below the first ratio of signal to noise darkness is to blame, above the second blur is; between them either may be. Any of
them may be for want of texture."""
_SHOWN = 6


@dataclass(frozen=True, slots=True)
class Contrast:
    """How much there is to see in an exposure.

    Attributes:
        signal_to_noise: see `photonpano.photometry.signal_to_noise`.
        blank: why there is nothing to see at all; None if there is something.
    """

    signal_to_noise: float
    blank: str | None = None


def contrast_of(exposure: VirtualExposure) -> Contrast:
    """Measure how far the variations of an exposure exceed its photon noise."""
    longest = exposure.weight.max()
    if longest == 0:
        return Contrast(0.0, "no pixel was seen")
    # Unlike max and min, these pass over what is unknown.
    if np.fmax.reduce(exposure.flux, axis=None) <= 0:
        return Contrast(0.0, "no pixel saw a photon; is the shutter closed, or the file the right one?")
    darkest = exposure.response.mean_count(np.fmin.reduce(exposure.flux, axis=None, keepdims=True))
    brightest = exposure.response.mean_count(np.array([np.inf], np.float32))
    # Half a frame is taken to be dark in a pixel that is always lit; one whole dark frame is the next there can be.
    if brightest.item() - darkest.item() < 0.75 / longest:
        return Contrast(0.0, "every pixel is as bright as can be told, so that its flux is unknown; use a darker aperture")
    return Contrast(signal_to_noise(exposure))


def require_tied(
    level: int,
    groups: Sequence[Group],
    edges: Sequence[Edge],
    parts: NDArray[np.integer],
    contrasts: Mapping[int, Contrast],
    disconnected: Literal["error", "largest"],
) -> None:
    """Refuse to go on when too many exposures are not tied to the others.

    Single exposures may be lost, since the motion is interpolated across them. A longer run is an error unless the spec
    asks for the largest part; less than two located exposures is always one.

    Args:
        level: from 1.
        groups: the groups of the level.
        edges: the pairs that were tried.
        parts: (N,) number of the part that each exposure is tied to, 0 for the largest.
        contrasts: how much there is to see in each exposure.
        disconnected: what the spec asks for.

    Raises:
        LocationError: says which frames are lost, which are tied together, and why pairs failed.
    """
    tied = parts == 0
    if len(groups) == 1:
        return
    runs = _runs(groups, ~tied)
    longest = max(map(len, runs), default=0)
    if tied.sum() >= 2 and (longest <= TOLERATED_RUN or disconnected == "largest"):
        return
    failures = [edge for edge in edges if isinstance(edge.motion, NotLocated)]
    lost = [_frames(run) for run in runs]
    lines = [
        f"level {level}: {len(failures)} of {len(edges)} pairs of exposures could not be located, "
        f"so that {_listed(lost)} cannot be tied to the rest"
        if tied.sum() >= 2
        else f"level {level}: none of the {len(edges)} pairs of exposures could be located"
    ]
    if tied.sum() >= 2:
        lines.append(f"Tied together are {_tied_together(groups, parts)}.")
    lines += [_pair(edge, groups) for edge in failures[:_SHOWN]]
    if len(failures) > _SHOWN:
        lines.append(f"  ... and {len(failures) - _SHOWN} more")
    lines += _advice(groups, tied, contrasts)
    if tied.sum() >= 2:
        lines.append("To go on with the largest part alone, set graph.disconnected to largest.")
    raise LocationError("\n".join(lines))


def _tied_together(groups: Sequence[Group], parts: NDArray[np.integer]) -> str:
    """List the parts of at least two exposures by the frames that they hold, the largest first."""
    sizes = np.bincount(parts)
    held = [
        " with ".join(_frames(run) for run in _runs(groups, parts == part)) for part in np.flatnonzero(sizes >= 2)[: _SHOWN + 1]
    ]
    return "; ".join(held[:_SHOWN]) + ("; and others" if len(held) > _SHOWN else "")


def _advice(groups: Sequence[Group], tied: BoolArray, contrasts: Mapping[int, Contrast]) -> list[str]:
    lost = [contrasts[int(index)] for index in np.flatnonzero(~tied)] if not tied.all() else list(contrasts.values())
    if all(contrast.blank for contrast in lost):
        return []
    ratio = float(np.median([contrast.signal_to_noise for contrast in lost if not contrast.blank]))
    size = int(np.median([len(group.span) for group in groups]))
    seen = f"In these exposures of {size} frames the scene varies {ratio:.2g} times as much as a pixel's photon noise"
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


def _pair(edge: Edge, groups: Sequence[Group]) -> str:
    assert isinstance(edge.motion, NotLocated)
    return f"  {groups[edge.moving]} onto {groups[edge.fixed]}: {edge.motion.reason}"


def _runs(groups: Sequence[Group], flags: BoolArray) -> list[Sequence[Group]]:
    """Return the runs of groups whose flag is set."""
    return [groups[run.start : run.stop] for run in true_spans(flags)]


def _frames(groups: Sequence[Group]) -> str:
    return str(FrameSpan(groups[0].span.start, groups[-1].span.stop))


def _listed(parts: Sequence[str]) -> str:
    if len(parts) > _SHOWN:
        return f"{', '.join(parts[:_SHOWN])} and {len(parts) - _SHOWN} more spans"
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if len(parts) > 1 else parts)
