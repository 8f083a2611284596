"""Pose estimator `colmap-averages`: averages of frames into COLMAP, and a spline through their poses (paper, section 6)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from photonpano import (
    BoolArray,
    CaptureSummary,
    FloatArray,
    FluxImage,
    FrameSpan,
    Group,
    LocationError,
    Progress,
    Reason,
    Source,
    StageContext,
    VirtualExposure,
    capture_of,
)
from photonpano.geometry import Camera, camera_matrix, positions_of
from photonpano.locating import blur_against_noise, stabilised_8_bit
from photonpano_colmap.exposures import PoseSpline, left_out, lit_counts
from photonpano_colmap.hooks import MIN_AVERAGES, ColmapAveragesConfig, counted, starts_of, too_few_averages
from photonpano_colmap.reconstruction import FOCAL_BIAS, Piece, PoseNoise, Reconstruction, pose_noise, reconstruct
from photonpano_poses import CameraGuess, LostFrames, PosedView, PoseEstimate, ScenePoints, with_depth

_PHOTONS = 60.0  # photons per pixel of an average; with fewer, keypoints are noise
_BLUR_PX = 6.0  # motion blur of an average that keypoints tolerate; the shorter average of both limits is taken
_MOST = 150  # most averages of a capture: matching all pairs of more takes many minutes
_FEWEST = 24  # fewest averages of a capture that is long enough
_SHORTEST = 4
_TEXTURE = 60, 15  # keypoints of an average, and matches with another, below which there is too little texture
# Fraction of matched keypoints below which noise or blur, not the path of the camera, is why there are no poses.
_FEW_MATCH = 0.25
_ANOTHER_SIZE = "choose a larger pose.with.group_size for less noise, or a smaller one for less blur"
_FOCAL_SHARE = 0.02  # relative standard error of an estimated focal length above which poses are doubtful
_GIVE_FOCAL = "calibrate the camera, and give camera.focal_px"
_PLANE = 0.01  # points lie in a plane if their smallest extent is below this fraction of the largest
_SHOWN_PIECES = 4
_TILT_SHARE = 0.5  # of the errors of positions that changes slowly along the path: measured on 20 captures, 0.1 to 1.1
_MISSED_SHARE = 0.5  # interpolation error of the spline, as a fraction of the variance of leave-one-out errors


class AveragesEstimator:
    """Averages groups of frames, lets COLMAP find their poses, and interpolates."""

    def __init__(self, config: ColmapAveragesConfig, context: StageContext) -> None:
        self._config = config
        self._context = context

    def estimate(self, source: Source, camera: CameraGuess, progress: Progress) -> PoseEstimate:
        """Estimate the poses of a capture: see `photonpano_poses.PoseEstimator`."""
        estimate = with_focal_judged(self.averaged(source, camera, progress), self._context)
        return with_depth(source, estimate, self._context.threads, progress) if self._config.depth else estimate

    def averaged(self, source: Source, camera: CameraGuess, progress: Progress) -> PoseEstimate:
        """Estimate the poses, without judging a focal length that was found.

        Raises a `LocationError` if averages show too little texture, the camera only turns or hardly travels, or poses fall
        into pieces.
        """
        spans = self._spans(source.info.n_frames)
        images = []
        with progress.stage("average frames", len(spans), "average") as advance:
            for span in spans:
                exposure = _exposure(source, span)
                image, mask = stabilised_8_bit(exposure, blur_against_noise(exposure, "auto"))
                images.append((image, np.where(mask > 0, 255, 0).astype(np.uint8)))
                advance(1)
        with progress.stage("COLMAP: features, matches, poses", 1, "model") as advance:
            found = reconstruct(images, camera, self._config, self._context.seed)
            advance(1)
        piece = self._chosen(found, spans, camera.focal_px)
        return _Assembly(source, spans, found, piece, camera).estimate()

    def _spans(self, n_frames: int) -> list[FrameSpan]:
        """Return the frames of each average."""
        size = self._config.group_size
        if size == "auto":
            size, reason = chosen_size(self._context.capture(), n_frames)
            self._context.decide("group_size", size, reason)
        if problem := too_few_averages(n_frames, size, self._config.step):
            raise LocationError(problem)
        return [FrameSpan(start, start + size) for start in starts_of(n_frames, size, self._config.step)]

    def _chosen(self, found: Reconstruction, spans: Sequence[FrameSpan], focal_px: float | None) -> Piece:
        """Return the piece of the poses to go on with."""
        texture = [float(np.median(each)) for each in (found.n_keypoints, found.n_matches)]
        if texture[0] < _TEXTURE[0] or texture[1] < _TEXTURE[1]:
            raise LocationError(
                f"the averages show too little texture, or too much noise: of {texture[0]:.0f} keypoints in an average (the "
                f"median) {texture[1]:.0f} match another average; {_ANOTHER_SIZE}"
            )
        if not found.pieces or len(found.pieces[0].images) < MIN_AVERAGES:
            if found.free_focal is not None and len(found.free_focal.images) >= MIN_AVERAGES:
                raise LocationError(
                    f"COLMAP finds no poses with the focal length that is given, camera.focal_px = {focal_px:g}, and does with "
                    f"{found.free_focal}: correct it, or leave it out"
                )
            keypoints, matches = (int(np.median(each)) for each in (found.n_keypoints, found.n_matches))
            figures = f"of {keypoints} keypoints in an average (the median) {matches} match another average"
            if matches < _FEW_MATCH * keypoints:
                raise LocationError(f"COLMAP found no poses: {figures}, so noise or blur hides the scene; {_ANOTHER_SIZE}")
            raise LocationError(
                "COLMAP found no poses: no two averages share enough of the scene from places that lie far enough apart; "
                f"{figures}. If the camera only turns, leave out `pose` and set motion: {{model: rotation}}; otherwise move "
                "farther, or try another pose.with.group_size"
            )
        piece = found.pieces[0]
        if len(found.pieces) > 1 and self._config.disconnected == "error":
            named = "; ".join(_described(each, spans) for each in found.pieces[:_SHOWN_PIECES])
            raise LocationError(
                f"the poses fall into {len(found.pieces)} pieces that are not connected: {named}. Choose a smaller "
                "pose.with.step, so that neighbours overlap more, or keep the largest with pose.with.disconnected: largest"
            )
        angle = np.rad2deg(np.median(parallax(piece)))
        if angle < self._config.min_parallax_deg:
            raise LocationError(
                f"the camera travels too little: the views of a point differ by {angle:.2g} degrees (the median), less than "
                f"{self._config.min_parallax_deg:g}, so that depth cannot be told from noise. If the camera only turns, leave "
                "out `pose` and set motion: {model: rotation}; otherwise move farther, or lower pose.with.min_parallax_deg"
            )
        if piece.readings.is_reversed:
            self._context.decide("depth_reversed", True, str(piece.readings))
        return piece


@dataclass(frozen=True, slots=True, eq=False)
class _Assembly:
    """Makes the estimate of all frames from the poses of averages."""

    source: Source
    spans: Sequence[FrameSpan]
    found: Reconstruction
    piece: Piece
    guess: CameraGuess

    def estimate(self) -> PoseEstimate:
        piece, n_frames = self.piece, self.source.info.n_frames
        height, width = self.source.info.frame_shape
        centre = self.guess.centre_px or ((width - 1) / 2, (height - 1) / 2)
        camera = Camera(camera_matrix(piece.focal_px, centre), np.array(self.guess.distortion))
        ideal = [(indices, camera.ideal(xy)) for indices, xy in piece.observed]
        finds_focal = self.guess.focal_px is None
        noise = pose_noise(piece.poses, piece.points, ideal, camera.matrix, finds_focal)
        instants = np.array([self.spans[image].centre for image in piece.images])
        located = self._located(n_frames)
        frames = np.arange(n_frames, dtype=np.float64)
        poses = PoseSpline(instants, piece.poses).at(frames)
        poses[~located] = np.nan
        apart, angles = left_out(instants, piece.poses)
        std_position = _between(
            frames, instants, noise.std_position, apart=apart, located=located, of_halves=piece.halves.std_position
        )
        std_rotation = _between(
            frames, instants, noise.std_rotation, apart=angles, located=located, of_halves=piece.halves.std_rotation
        )
        std_rotation = np.hypot(std_rotation, tilt(piece.poses, np.maximum(noise.std_position, piece.halves.std_position)))
        if self.guess.focal_px is not None and self.found.free_focal is not None:
            missed = self.found.free_focal.missed(piece.images, piece.poses, self.guess.focal_px)
            shifts, angles = (np.interp(frames, instants, each) for each in missed)
            std_position, std_rotation = np.hypot(std_position, shifts), np.hypot(std_rotation, angles)
        views = tuple(self._view(place) for place in range(len(piece.images)))
        return PoseEstimate(
            camera_matrix=camera.matrix,
            distortion=camera.distortion,
            std_focal_px=math.hypot(noise.std_focal_px, FOCAL_BIAS * piece.focal_px) if finds_focal else 0.0,
            camera_from_world=poses,
            located=located,
            std_position=std_position,
            std_rotation_deg=np.rad2deg(std_rotation),
            points=ScenePoints(piece.points, flux_of_points(views, len(piece.points))),
            views=views,
            lost=self._lost(located),
            levels=(self._level(noise),),
            doubts=tuple(self._doubts()),
        )

    def _located(self, n_frames: int) -> BoolArray:
        """Return which frames lie in an average with a pose, or between two neighbours with poses: (T,)."""
        posed = np.zeros(len(self.spans), np.bool_)
        posed[self.piece.images] = True
        located = np.zeros(n_frames, np.bool_)
        for place in np.flatnonzero(posed).tolist():
            stop = self.spans[place].stop
            if place + 1 < len(posed) and posed[place + 1]:
                stop = max(stop, self.spans[place + 1].start)
            located[self.spans[place].start : stop] = True
        return located

    def _view(self, place: int) -> PosedView:
        image = int(self.piece.images[place])
        span, (points, xy) = self.spans[image], self.piece.observed[place]

        def flux() -> FluxImage:
            return _exposure(self.source, span).flux

        return PosedView(span, span.centre, self.piece.poses[place], points, xy, flux)

    def _lost(self, located: BoolArray) -> tuple[LostFrames, ...]:
        """Return the frames without a pose: those of averages that COLMAP left out, and the rest at the end."""
        others = {int(image): number for number, piece in enumerate(self.found.pieces[1:], 2) for image in piece.images}
        posed, lost = set(self.piece.images.tolist()), []
        edges = np.flatnonzero(np.diff(np.concatenate([[False], ~located, [False]]).astype(np.int8))).reshape(-1, 2)
        for start, stop in edges.tolist():
            inside = [
                number
                for number, span in enumerate(self.spans)
                if number not in posed and span.start < stop and span.stop > start
            ]
            elsewhere = [number for number in inside if number in others]
            if elsewhere:
                reason = f"their averages belong to piece {others[elsewhere[0]]}, which is not connected to the largest"
            elif inside:
                matches = int(self.found.n_matches[inside].max())
                reason = f"COLMAP found no pose for {counted(len(inside))}, with at most {matches} matching keypoints"
            else:
                reason = "they are fewer than an average"
            lost.append(LostFrames(FrameSpan(start, stop), reason))
        return tuple(lost)

    def _level(self, noise: PoseNoise) -> dict[str, float | int | str | None]:
        free = self.found.free_focal
        return {
            "group_frames": len(self.spans[0]),
            "averages": len(self.spans),
            "located": len(self.piece.images),
            "points": len(self.piece.points),
            "keypoints": float(np.median(self.found.n_keypoints)),
            "parallax_deg": float(np.rad2deg(np.median(parallax(self.piece)))),
            "residual_px": noise.residual_px,
            "free_focal_px": None if free is None else free.focal_px,
            "std_free_focal_px": None if free is None else free.std_px,
            "depth_readings": self.piece.readings.ratio,
            "std_position": relative_std(noise.std_position, self.piece.poses),
        }

    def _doubts(self) -> list[Reason]:
        doubts = [] if self.piece.readings.doubt is None else [self.piece.readings.doubt]
        given, free = self.guess.focal_px, self.found.free_focal
        if given is not None and free is not None and (doubt := free.doubt_of(given, "averages")) is not None:
            doubts.insert(0, doubt)
        extents = np.linalg.svd(self.piece.points - np.median(self.piece.points, axis=0), compute_uv=False)
        if self.guess.focal_px is None and extents[2] < _PLANE * extents[0]:
            flat = "the points lie in a plane, from which no focal length can be found"
            doubts.append(
                Reason(flat, 1 - extents[2] / extents[0], 1 - _PLANE, "1 less their depth over their width", _GIVE_FOCAL)
            )
        return doubts


def with_focal_judged(estimate: PoseEstimate, context: StageContext) -> PoseEstimate:
    """Record a focal length that was found, and doubt it if its expected error is large."""
    focal, std = float(estimate.camera_matrix[0, 0]), estimate.std_focal_px
    if not std:
        return estimate
    context.decide(
        "focal_px", round(focal, 2), f"found with the poses, with an expected error of {std:.2g} px; calibrate to be sure"
    )
    if std <= _FOCAL_SHARE * focal:
        return estimate
    where = f"found as {focal:.0f} px with an expected error of {std:.2g} px; as a share of it"
    doubt = Reason("the focal length is not known well", std / focal, _FOCAL_SHARE, where, _GIVE_FOCAL)
    return replace(estimate, doubts=(doubt, *estimate.doubts))


def flux_of_points(views: Sequence[PosedView], n_points: int) -> FluxImage:
    """Return the mean flux of the pixels in which views show each point: (n_points,); NaN where none does."""
    total, times = np.zeros(n_points), np.zeros(n_points)
    for view in views:
        flux = view.flux()
        column, row = (np.clip(np.rint(view.xy[:, axis]).astype(int), 0, flux.shape[1 - axis] - 1) for axis in (0, 1))
        seen = flux[row, column]
        known = np.isfinite(seen)
        np.add.at(total, view.points[known], seen[known])
        np.add.at(times, view.points[known], 1)
    return np.where(times > 0, total / np.maximum(times, 1), np.nan).astype(np.float32)


def relative_std(std_position: FloatArray, poses: FloatArray) -> float | None:
    """Return the root mean square error of positions, as a fraction of the path through them; None if the camera rests."""
    length = float(np.linalg.norm(np.diff(positions_of(poses), axis=0), axis=1).sum())
    return float(np.sqrt(np.mean(std_position**2))) / length if length else None


def tilt(poses: FloatArray, std_position: FloatArray) -> float:
    """Return the angle by which errors of positions tilt the aligned world about the principal axis of the path, in radians.

    The axis is near to all of the (N, 3, 4) poses, so that small errors, if they change slowly along the path, turn it far.
    It is 0 for a path that is straight but for these errors, about which an alignment leaves rotations as they are.
    """
    centred = positions_of(poses) - positions_of(poses).mean(axis=0)
    away = float(np.sqrt(np.sum(np.linalg.svd(centred, compute_uv=False)[1:] ** 2) / len(poses)))
    error = float(np.sqrt(np.mean(std_position**2)))
    return _TILT_SHARE * error / away if error < away else 0.0


def chosen_size(capture: CaptureSummary, n_frames: int) -> tuple[int, str]:
    """Return the frames of an average, and a clause with the reason.

    An average should have 60 photons a pixel, and a motion blur of at most 6 px: the shorter one is taken. A capture has 24 to
    150.
    """
    light = _PHOTONS / max(capture.flux, 1e-9)
    motion = math.inf if not capture.speed_px else _BLUR_PX / capture.speed_px
    wanted = min(light, motion)
    size = round(min(max(wanted, n_frames / _MOST, _SHORTEST), max(n_frames / _FEWEST, _SHORTEST)))
    speed = "at an unknown speed" if capture.speed_px is None else f"at {capture.speed_px:.2g} px per frame"
    blur = "" if capture.speed_px is None else f" and are blurred by {size * capture.speed_px:.2g} px"
    return size, f"{speed} ({capture.how}) averages of {size} frames hold {size * capture.flux:.2g} photons a pixel{blur}"


def parallax(piece: Piece) -> FloatArray:
    """Return for each point the largest angle between its directions from the first view and from another: (M,)."""
    places = positions_of(piece.poses)
    angles, first = np.zeros(len(piece.points)), np.full((len(piece.points), 3), np.nan)
    for place, (indices, _) in zip(places, piece.observed, strict=True):
        rays = piece.points[indices] - place
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        new = np.isnan(first[indices, 0])
        first[indices[new]] = rays[new]
        cosines = np.clip(np.einsum("ki,ki->k", rays, first[indices]), -1, 1)
        angles[indices] = np.maximum(angles[indices], np.arccos(cosines))
    return angles


def _exposure(source: Source, span: FrameSpan) -> VirtualExposure:
    """Average the frames of a span."""
    frames, valid = len(span), capture_of(source).masked_in(span).valid
    flux = source.response.flux(lit_counts(source, span) / np.float32(frames), float(frames))
    weight = np.where(valid, frames, 0).astype(np.float32)
    flux = np.where(valid, flux, np.nan).astype(np.float32)
    return VirtualExposure(flux, weight, Group(span, span.centre), 1.0, source.response)


def _between(
    frames: FloatArray, instants: FloatArray, std: FloatArray, *, apart: FloatArray, located: BoolArray, of_halves: float
) -> FloatArray:
    """Return the expected error of each frame, from poses and interpolation between them; NaN if not located.

    That of poses is, root mean square, no less than `of_halves`, which has what errs alike in many averages.
    """
    at_poses = np.interp(frames, instants, std * max(1.0, of_halves / float(np.sqrt(np.mean(std**2)))))
    # Distances of poses from the spline through the others hold the noise of the poses as well.
    missed = max(0.0, float(np.mean(apart**2)) - 2 * float(np.mean(std**2))) if len(apart) else 0.0
    return np.where(located, np.sqrt(at_poses**2 + _MISSED_SHARE * missed), np.nan)


def _described(piece: Piece, spans: Sequence[FrameSpan]) -> str:
    """Describe the frames of a piece."""
    images = piece.images
    runs = np.split(images, np.flatnonzero(np.diff(images) > 1) + 1)
    named = " and ".join(f"{spans[run[0]].start} to {spans[run[-1]].stop - 1}" for run in runs[:3])
    more = f" and {len(runs) - 3} more spans" if len(runs) > 3 else ""
    return f"frames {named}{more} ({len(images)} averages)"
