"""Pairs of exposures to register: neighbours, those some group lengths apart, and those with points that a user has tied."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from photonpano.contracts.protocols import Source, Trajectory, camera_of
from photonpano.errors import InputError
from photonpano.geometry import corners, inverse, jacobian, transform_points, why_implausible
from photonpano.text import listed
from photonpano.values import BoolArray, Edge, FloatArray, FrameSpan, Group, Homography, Located, StreamInfo

GYROSCOPE, TIE = "gyroscope", "tie"  # stand for the locators of pairs that no exposures show
_POINTS, _STD, _STD_PX = ("frame_a", "x_a", "y_a", "frame_b", "x_b", "y_b"), "std_px", 1.0
# A motion contradicts a tie beyond this fraction of the shorter side of a frame, and so many of its standard deviations.
_CONTRADICTION, _SIGMAS = 0.05, 8.0
# Expected distance of the corners from where a motion by ties alone puts them, in shorter sides of a frame.
_CORNERS = 0.1


def pairs_of(groups: Sequence[Group], skips: Sequence[float]) -> list[tuple[int, int]]:
    """Return the pairs (moving, fixed) of a level, moving later than fixed, ordered by the moving exposure.

    Exposures that share photons share their noise, which confirms the motion along which they were merged. Neighbours that
    overlap in time are therefore no pairs, unless the graph would fall apart without them.

    Each exposure is paired with those whose instants are closest to the `skips`, in mean lengths of both groups, before and
    after its own; at the shortest, also with the next one beyond, since dense exposures would otherwise fall into separate
    chains. Without skips, the pairs are a chain of neighbours.
    """
    instants, lengths = instants_of(groups), lengths_of(groups)
    pairs: set[tuple[int, int]] = set()
    for index, (instant, length) in enumerate(zip(instants, lengths, strict=True)):
        distances = (instants - instant) / ((lengths + length) / 2)
        for skip in skips:
            for target in (-skip, skip):
                if not distances[0] - 0.5 / length <= target <= distances[-1] + 0.5 / length:
                    continue
                partner = int(np.argmin(np.abs(distances - target)))
                beyond = partner + (1 if target > 0 else -1)
                partners = [partner, beyond] if skip == min(skips) else [partner]
                pairs |= {
                    (max(index, each), min(index, each)) for each in partners if each != index and 0 <= each < len(groups)
                }
    # Neighbours connect the graph, for instance of a capture that is hardly longer than a group.
    labels = component_labels(len(groups), np.array(sorted(pairs), dtype=int).reshape(-1, 2))
    pairs |= {
        (later, later - 1)
        for later in range(1, len(groups))
        if labels[later] != labels[later - 1] or not shared_share(groups[later].span, groups[later - 1].span)
    }
    return sorted(pairs)


def alike(pairs: Sequence[tuple[int, int]], to_plane: FloatArray, shape: tuple[int, int]) -> list[tuple[int, int]]:
    """Leave out the pairs that see too little alike by the motion known so far, (N, 3, 3), if others tie their exposures."""
    seen = [pair for pair in pairs if not why_implausible(inverse(to_plane[pair[1]]) @ to_plane[pair[0]], shape)]
    left, tied = (component_labels(len(to_plane), np.array(some, dtype=int).reshape(-1, 2)) for some in (seen, pairs))
    return seen if left.max() == tied.max() else list(pairs)


def excluded_pairs(groups: Sequence[Group], frames: Sequence[tuple[int, int]]) -> set[tuple[int, int]]:
    """Return the pairs (moving, fixed) of exposures of which one holds the first and the other the second of two `frames`."""

    def holding(frame: int) -> list[int]:
        return [index for index, group in enumerate(groups) if group.span.start <= frame < group.span.stop]

    return {(max(one, other), min(one, other)) for a, b in frames for one in holding(a) for other in holding(b) if one != other}


def shared_share(first: FrameSpan, second: FrameSpan) -> float:
    """Return the share of the shorter of two spans that lies in the other."""
    common = min(first.stop, second.stop) - max(first.start, second.start)
    return max(0, common) / min(len(first), len(second))


def adjacency(n_nodes: int, pairs: NDArray[np.integer], weights: FloatArray | None = None) -> sparse.csr_array:
    """Return the adjacency matrix of a graph: the (P,) weights of its (P, 2) pairs, or 1, at their rows and columns."""
    given = np.ones(len(pairs)) if weights is None else weights
    return sparse.csr_array((given, (pairs[:, 0], pairs[:, 1])), shape=(n_nodes, n_nodes))


def component_labels(n_nodes: int, pairs: NDArray[np.integer]) -> NDArray[np.integer]:
    """Number the connected components of a graph, given its (P, 2) pairs: (N,) the component of each node."""
    return np.asarray(connected_components(adjacency(n_nodes, pairs), directed=False)[1])


def instants_of(groups: Sequence[Group]) -> FloatArray:
    """Return the reference instants of the groups: (N,)."""
    return np.array([group.reference for group in groups])


def lengths_of(groups: Sequence[Group]) -> FloatArray:
    """Return the number of frames of each group: (N,)."""
    return np.array([float(len(group.span)) for group in groups])


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Ties:
    """Points that show one place in two frames, of which the later one comes first."""

    file: Path
    lines: NDArray[np.integer]  # (T,) in the file, from 1
    frames: FloatArray  # (T, 2)
    points: FloatArray  # (T, 2, 2) x and y in px of each frame, as the camera sees it through its lens
    std_px: FloatArray  # (T,) expected error of each
    frame_shape: tuple[int, int]  # (height, width) of a frame

    def exposures(self, groups: Sequence[Group]) -> NDArray[np.integer]:
        """Return the exposures whose instants lie nearest to the frames: (T, 2)."""
        return np.asarray(np.abs(self.frames[..., None] - instants_of(groups)).argmin(axis=-1))

    def away_px(self, motions: Homography) -> FloatArray:
        """Return how far from the point in the earlier frame a motion, (3, 3) or (T, 3, 3), puts the other one: (T, 2)."""
        moved = transform_points(np.broadcast_to(motions, (len(self.points), 3, 3)), self.points[:, :1])
        return np.asarray(moved[:, 0] - self.points[:, 1])

    @property
    def tolerance_px(self) -> FloatArray:
        """The distance from which on a motion contradicts each: (T,)."""
        return _CONTRADICTION * min(self.frame_shape) + _SIGMAS * self.std_px


@dataclass(frozen=True, slots=True, eq=False)
class TiedPair:
    """Two exposures, and the points that tie them to each other."""

    moving: int
    fixed: int
    ties: Ties  # moved to the instants of the exposures

    @property
    def motion(self) -> Homography:
        """The simplest motion through the points: a shift for one, with a roll for two or three, a homography from four on."""
        moving, fixed = self.ties.points.swapaxes(0, 1)
        if len(moving) >= 4:
            found, _ = cv2.findHomography(moving, fixed, 0)
            if found is not None and not why_implausible(found, self.ties.frame_shape):
                return np.asarray(found)
        # As complex numbers, a roll is a factor.
        factor = complex(np.vdot((moving - moving.mean(axis=0)) @ [1, 1j], (fixed - fixed.mean(axis=0)) @ [1, 1j]))
        roll = factor / abs(factor) if factor else 1
        found = np.array([[roll.real, -roll.imag, 0], [roll.imag, roll.real, 0], [0, 0, 1]])
        found[:2, 2] = fixed.mean(axis=0) - found[:2, :2] @ moving.mean(axis=0)
        return found

    def checked(self, edge: Edge) -> Edge:
        """Return the pair as it was registered; if it was not, or contradicts the points, with the motion by the points alone.

        That counts for little beside photons: the points hold within their errors, the corners within a tenth of a frame.
        """
        ties = self.ties
        if isinstance(edge.motion, Located):
            away_px = np.linalg.norm(ties.away_px(edge.motion.homography), axis=1)
            if (away_px <= ties.tolerance_px).all():
                return edge
        points = np.concatenate([ties.points[:, 0], corners(ties.frame_shape)])
        std_px = np.concatenate([ties.std_px, np.full(4, _CORNERS * min(ties.frame_shape))])
        slopes = jacobian(self.motion, points) / std_px[:, None, None]
        information = np.einsum("nki,nkj->ij", slopes, slopes)
        return Edge(self.moving, self.fixed, Located(self.motion, information, evidence={"ties": len(ties.lines)}), TIE)


def ties_of(file: Path | None, source: Source) -> Ties | None:
    """Read the ties of a capture, in ideal pixels where its lens is known; None without a file."""
    if file is None:
        return None
    ties, camera = read_ties(file, source.info), camera_of(source)
    return ties if camera is None else replace(ties, points=camera.ideal(ties.points.reshape(-1, 2)).reshape(-1, 2, 2))


def tied_pairs(ties: Ties | None, groups: Sequence[Group], known: Trajectory | None) -> list[TiedPair]:
    """Return the pairs of exposures that ties belong to, ordered by the moving one; `known` is the motion known so far."""
    if ties is None:
        return []
    if known is not None:
        instants = instants_of(groups)[ties.exposures(groups)].ravel()
        to_exposures = inverse(known.at(instants)) @ known.at(ties.frames.ravel())
        points = transform_points(to_exposures, ties.points.reshape(-1, 1, 2)).reshape(-1, 2, 2)
        ties = replace(ties, points=points)
    pairs: dict[tuple[int, int], list[int]] = {}
    for place, (moving, fixed) in enumerate(ties.exposures(groups).tolist()):
        if moving != fixed:
            pairs.setdefault((moving, fixed), []).append(place)
    return [TiedPair(*pair, _some(ties, np.array(places))) for pair, places in sorted(pairs.items())]


def require_agreement(ties: Ties | None, groups: Sequence[Group], located: BoolArray, trajectory: Trajectory) -> None:
    """Raise an `InputError` for ties that the motion of the (N,) `located` exposures contradicts."""
    if ties is None or not (judged := located[ties.exposures(groups)].all(axis=1)).any():
        return
    ties = _some(ties, judged)
    later, earlier = trajectory.at(ties.frames.ravel()).reshape(-1, 2, 3, 3).swapaxes(0, 1)
    away = ties.away_px(inverse(earlier) @ later)
    away_px = np.linalg.norm(away, axis=1)
    if (away_px <= ties.tolerance_px).all():
        return
    worst = int((away_px / ties.tolerance_px).argmax())
    # Only ties across the same frames can contradict each other.
    last, first = ties.frames[worst]
    across = (ties.frames[:, 1] < last) & (first < ties.frames[:, 0])
    apart_px = np.where(across, np.linalg.norm(away - away[worst], axis=1), 0)
    other = int(apart_px.argmax())
    if apart_px[other] > ties.tolerance_px[worst]:
        named = listed(map(str, sorted(ties.lines[[worst, other]])))
        raise InputError(
            f"{ties.file}: lines {named} contradict each other by {apart_px[other]:.0f} px, by the motion that fits all pairs "
            "best; correct the wrong one, or remove it"
        )
    raise InputError(
        f"{ties.file}: line {ties.lines[worst]} contradicts the motion that fits all pairs best by {away_px[worst]:.0f} px; "
        "correct it, or remove it; if exposures are registered wrongly with each other, leave these out with graph.exclude"
    )


def read_ties(file: Path, info: StreamInfo) -> Ties:
    """Read ties from a CSV file with a header.

    Raises:
        InputError: the file cannot be read, or holds anything but points in frames of the capture.
    """
    if not file.exists():
        raise InputError(f"there is no file {file}; check the path")
    try:
        with file.open(encoding="utf-8-sig", newline="") as text:
            reader = csv.DictReader(text)
            names = [name.strip() for name in reader.fieldnames or ()]
            if set(names) - {_STD} != set(_POINTS) or len(set(names)) < len(names):
                expected = f"{', '.join(_POINTS)} and, if wanted, {_STD}"
                raise InputError(f"{file}: the first line must name the columns {expected}; it is {','.join(names)!r}")
            reader.fieldnames = names
            rows: dict[int, list[float]] = {}
            for row in reader:
                rows[reader.line_num] = _row(row, f"{file}, line {reader.line_num}", info)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{file} is no CSV file that can be read: {error}") from error
    if not rows:
        raise InputError(f"{file} holds no ties; write a line for each, below the names of the columns, or remove graph.tie")
    numbers = np.array(list(rows.values()))
    sides = numbers[:, :6].reshape(-1, 2, 3)
    sides = np.take_along_axis(sides, np.argsort(-sides[..., :1], axis=1), axis=1)
    return Ties(
        file=file,
        lines=np.array(list(rows)),
        frames=sides[..., 0],
        points=sides[..., 1:],
        std_px=numbers[:, 6],
        frame_shape=info.frame_shape,
    )


def _row(row: dict[str, str], where: str, info: StreamInfo) -> list[float]:
    """Return the numbers of a line, in the order of the columns; the standard deviation is the last."""
    numbers: dict[str, float] = {}
    if None in row or None in row.values():
        raise InputError(f"{where}: expected a value for each of the {len(row) - (None in row)} columns")
    limits = {"frame": (0, info.n_frames - 1), "x": (-0.5, info.width - 0.5), "y": (-0.5, info.height - 0.5)}
    for column in (*_POINTS, _STD):
        low, high = limits.get(column.partition("_")[0], (0.01, 1000))
        written = row.get(column, "").strip() or (str(_STD_PX) if column == _STD else "")
        try:
            number = float(written)
        except ValueError:
            number = math.nan
        if not low <= number <= high or (column.startswith("frame") and number % 1):
            kind = "a frame of the capture" if column.startswith("frame") else "px"
            raise InputError(f"{where}, column {column}: expected {kind}, {low:g} to {high:g}, got {written!r}")
        numbers[column] = number
    if numbers["frame_a"] == numbers["frame_b"]:
        raise InputError(f"{where}, column frame_b: expected another frame than frame_a, got {row['frame_b']} for both")
    return list(numbers.values())


def _some(ties: Ties, chosen: NDArray[np.integer] | BoolArray) -> Ties:
    values = {name: getattr(ties, name)[chosen] for name in ("lines", "frames", "points", "std_px")}
    return replace(ties, **values)
