"""Find what hides the background for a time, as it moves by itself or stands near; and show it as it was at some moments."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d, uniform_filter, uniform_filter1d

from photonpano.capture import capture_of, with_background
from photonpano.contracts.protocols import Source, Trajectory
from photonpano.corrections.gains import least_weight, scene_canvas
from photonpano.corrections.geometry import speed_px
from photonpano.errors import InputError
from photonpano.execution.context import Context
from photonpano.filtering import gradient_of
from photonpano.geometry import PATCHES, Camera, Canvas
from photonpano.merging import Chunk, accumulate, binned_mean
from photonpano.motion.models import APART
from photonpano.reading import reading
from photonpano.robust import cauchy_weights, robust_std
from photonpano.values import CELL_PX, Background, BoolArray, Decision, FloatArray, FluxImage, FrameSpan, Homography

LAYERS_FILE = "layers.npz"
_ARRAYS = ("instants", "shown", "filled")
_INSTANTS = 400  # at which frames are compared with the background
# Wanted photons of a square in a sum of frames, most frames of a sum, and most motion within them.
_PHOTONS, _LONGEST_SPAN, _MOTION_PX = 400.0, 96, 4.0
_FEWEST_PHOTONS, _FEWEST_SUMS = 100.0, 24  # of a square, and of frames, by which something is told from the background
_PROBES = 5  # frames by which the flux is estimated
_COVERED = 0.5  # share of the frames of a sum that must have seen a square
# Standard deviation of the Gaussian that weights the pixels of a square, in halves of its side: sums must not depend on the
# sub-pixel position of a frame.
_BLUR = 1.0
_BINS, _TAIL = 64, 1e-3  # of the histograms of brightness, and the share of squares beyond their ends
_NEAR = 2.5  # standard deviations from the usual brightness within which squares are averaged
_USUAL = 0.3  # least share of the sums that show a place, in which it has its usual brightness
_UNEVEN = 0.02  # share of their brightness that squares may differ by beyond photon noise
_MEDIAN = 0.455  # the median of the square of a Gaussian number of unit variance
_AROUND = np.ones((3, 3))  # squares that are tested together
_SURE = 6.0  # standard deviations by which a patch hides the background
_FEWEST = 4  # squares of a patch that are sure
_ROUNDS, _TINY = 4, 1e-6  # of the fit of light and shift
# Mean square of places that have no usual brightness, relative to the median place, and times that they were seen. What errors
# of the motion change is thin: the mean is over this side, in squares. The least mean square of a place, in variances; the
# largest share of such places, since along a wrong motion nearly all change.
_CHANGING, _FEWEST_SEEN, _TOGETHER, _STEADY, _MOST_CHANGING = 3.0, 8, 5, 0.6, 0.35
_SMOOTH = 5  # sums over which deviations are averaged where the background was never seen
_LEAST_HIDDEN = 0.25  # share of the sums that are taken for the background there
_SIZES = 1.6  # largest ratio of the size of a mover that is shown several times to the usual one, and its inverse
_CUT_BY_BORDER = 2.0  # largest square of the length of its cut by the border of a frame, in areas
_APART = np.ones((13, 13), np.uint8)  # half cells around a mover that is shown several times, without others
_BESIDE = np.ones((5, 5), np.uint8)  # half cells that a cell covers, and those beside it
_BESIDE_BORDERS = np.ones((7, 7), np.uint8)  # that, and the half cells at the borders of frames, which others may not see
_MOVED, _LONGEST = 0.03, 8  # share of a mover that leaves its place while it is shown, and most instants, to either side


class _Tolerance(NamedTuple):
    """How carefully the background is told from what hides it, as the motion is known."""

    misplaced_px: float  # errors of the motion, by which squares may differ beyond photon noise
    thick: int  # least height and width of a patch, in squares, with those beside it: errors of the motion are thin
    beside: float  # standard deviations by which squares beside a patch belong to it
    least: float  # least share of what all frames see that is hidden
    most: float  # largest share of what a frame sees that is hidden


_ROUGH, _EXACT = _Tolerance(0.75, 5, 2.5, 0.06, 0.6), _Tolerance(0.5, 3, 2.0, 0.02, 0.8)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The brightness of squares of the scene, of 8 px a side, in S sums of frames."""

    spans: list[FrameSpan]
    motions: FloatArray  # (S, 3, 3) of the frames, to the reference plane
    canvas: Canvas  # whose pixels are quarters of the squares
    root: FluxImage  # (S, h, w) square root of their flux, whose noise hardly depends on it; 0 where not seen
    std: FluxImage  # (S, h, w) its standard deviation by photon noise; infinite where not seen

    @property
    def known(self) -> BoolArray:
        """(S, h, w) what was seen."""
        return np.isfinite(self.std)

    def evenly_lit(self) -> _Seen:
        """Return the sums in the same light, as far as each and the next, which see much of the same, tell."""
        steps = np.ones(len(self.root))
        for index, both in enumerate(self.known[1:] & self.known[:-1], start=1):
            before, after = (float(each[both].sum()) for each in self.root[index - 1 : index + 1])
            steps[index] = after / before if min(before, after) > 0 else 1.0
        light = np.cumprod(steps)[:, None, None].astype(np.float32)
        return replace(self, root=self.root / light, std=self.std / light)

    def steady(self, usual: FluxImage) -> _Seen:
        """Return the sums in the same light, and without a shift of each, given the roots that squares usually have.

        The motion is not exact, and a tremor may be left in it.
        """
        slopes, steady, std = gradient_of(usual), self.root.copy(), self.std.copy()
        for index, (root, known) in enumerate(zip(self.root, self.known, strict=True)):
            terms, weight = np.stack([each[known] for each in (usual, *slopes)], axis=1), np.ones(int(known.sum()))
            for _ in range(_ROUNDS):
                scaled = terms * weight[:, None]
                change = np.linalg.lstsq(scaled, weight * root[known])[0]
                left = root[known] - terms @ change
                weight = np.sqrt(cauchy_weights(left, _NEAR * max(robust_std(left), _TINY)))
            light = max(float(change[0]), _TINY)
            steady[index, known] = (usual[known] + left / light) if known.any() else 0
            std[index] /= light
        return replace(self, root=steady, std=std)


def find_background(
    source: Source,
    trajectory: Trajectory,
    camera: Camera | None,
    span: FrameSpan,
    context: Context,
    *,
    exact: bool = False,
) -> Background | None:
    """Find the parts of the frames of a span that show the background; None if all do. The `camera` is None unless it turns.

    The background of a place is the brightness that it has most often: that of things that pass is spread over many values. A
    patch of squares that differs from it by more than photon noise hides it. Along an `exact` motion, smaller patches do, and
    the background is not known where what is left of a place still changes.
    """
    tolerance = _EXACT if exact else _ROUGH
    seen = _seen(source, trajectory, camera, span, context)
    if seen is None or len(seen.spans) < _FEWEST_SUMS or not (known := seen.known).any():
        return None
    seen = seen.steady(_usual(seen.evenly_lit())[0])
    usual, sure = _usual(seen)
    squares = _squares(seen, usual, tolerance.misplaced_px)
    deviation = _deviation(squares, known)
    hidden = np.array([_patches(*each, tolerance) for each in zip(deviation, known, strict=True)])
    # Where nearly all differs, the motion is wrong.
    hidden &= (hidden.sum(axis=(1, 2)) < tolerance.most * known.sum(axis=(1, 2)))[:, None, None]
    if exact:
        sure &= ~_changing(squares, known & ~hidden)
    hidden |= known & ~sure
    if hidden[known].mean() < tolerance.least:
        return None
    instants = np.array([each.centre for each in seen.spans])
    filled = _seen_somewhere(hidden, deviation, known)
    shown, filled = (~_in_frames(source, seen, _beyond_borders(each, known)) for each in (hidden, filled))
    return Background(instants, shown, filled, source.info.frame_shape)


def without_layers(
    background: Background | None, instants: FloatArray, layers: FloatArray, frame_shape: tuple[int, int]
) -> Background | None:
    """Leave out the patches of frames that do not follow the motion of the camera, too; None if nothing is left out.

    The panorama shows them: most places behind what is near are never seen.

    Given are, at N instants, the mean squares of the residuals of patches, (N, P): see `GraphSolution`.
    """
    apart = (layers > APART).reshape(len(layers), PATCHES, PATCHES)
    if not apart.any():
        return background
    around = maximum_filter1d(apart, 3, axis=0, mode="nearest")
    rows, columns = (
        ((np.arange(0, side, CELL_PX) + CELL_PX / 2) * PATCHES / side).astype(int).clip(0, PATCHES - 1) for side in frame_shape
    )
    # A patch is not divided where what is near ends.
    wider = np.ones((5, 5), np.uint8)
    cells = np.array([cv2.dilate(each, wider) for each in around[:, rows][:, :, columns].astype(np.uint8)]) > 0
    near = Background(instants, ~cells, np.ones_like(cells), frame_shape)
    return near if background is None else background.without(near)


def decision_of(background: Background) -> Decision:
    """Return what was found, for the record."""
    hidden = 1 - background.shown.mean(axis=(1, 2))
    most = round(float(background.instants[int(np.argmax(hidden))]))
    reason = f"do not show the background, which moves as the camera does, most at frame {most} ({hidden.max():.0%})"
    share = background.hidden_share
    return Decision("movers", round(share, 4), f"{share:.1%} of the frames {reason}; they are left out")


def _seen(source: Source, trajectory: Trajectory, camera: Camera | None, span: FrameSpan, context: Context) -> _Seen | None:
    """Sum the frames all over a span; None if too few photons arrive while the image hardly moves."""
    probes = [binned_mean(source, each) for each in source.info.spread(_PROBES, 1)]
    photons = float(np.nanmean(probes)) * np.pi * (_BLUR * CELL_PX) ** 2
    longest = min(_PHOTONS / max(photons, 1e-9), _MOTION_PX / max(speed_px(source, trajectory), 1e-9))
    length = int(np.clip(longest, 1, min(_LONGEST_SPAN, len(span))))
    if length * photons < _FEWEST_PHOTONS:
        return None
    centres = np.linspace(span.start + length / 2, span.stop - length / 2, min(_INSTANTS, len(span) // length))
    spans = [FrameSpan(start, start + length) for start in (centres - length / 2).astype(int).tolist()]
    motions = trajectory.at([each.centre for each in spans])
    fine = scene_canvas(camera, motions, source.info.frame_shape, 2 / CELL_PX)
    canvas = fine.part(0, 0, fine.height // 2 * 2, fine.width // 2 * 2)
    summed = partial(_brightness, source, canvas, _COVERED * least_weight(source, CELL_PX))
    root, std = (
        np.array(images) for images in zip(*context.in_order(summed, [*zip(spans, motions, strict=True)]), strict=True)
    )
    return _Seen(spans, motions, canvas, root, std)


def _brightness(
    source: Source, canvas: Canvas, covered: float, place: tuple[FrameSpan, Homography]
) -> tuple[FluxImage, FluxImage]:
    """Return the square root of the flux of squares in a sum of frames, and its standard deviation: (h, w) each.

    A square is seen in the share `covered` of the frames at least. `place` is the span, and where its frames lie.
    """
    span, homography = place
    photons = accumulate(source, [Chunk(span, homography)], canvas, canvas.shape)
    frames = photons.weight if photons.lit is None else photons.lit.frames.sum(axis=0)
    counts, weight, frames = (
        cv2.GaussianBlur(each, (0, 0), _BLUR)[1::2, 1::2] for each in (np.maximum(photons.counts, 0), photons.weight, frames)
    )
    seen = frames > covered * len(span)
    mean = np.where(seen, counts / np.maximum(weight, np.float32(1e-3)), 0).astype(np.float32)
    exposure = np.maximum(weight * np.float32(np.pi * (_BLUR * CELL_PX) ** 2), np.float32(1))
    flux = source.response.flux(mean, exposure)
    root, step = np.sqrt(np.maximum(flux, 0)), np.float32(0.5) / np.sqrt(exposure)
    lit = np.maximum(flux, 1 / exposure)
    return root, np.where(seen, step * np.sqrt(np.expm1(np.minimum(lit, 20)) / lit), np.float32(np.inf)).astype(np.float32)


def _usual(seen: _Seen) -> tuple[FluxImage, BoolArray]:
    """Return the root of the flux that squares have most often, and for which ones that is often enough: (h, w) each."""
    known, root, shape = seen.known, seen.root, seen.root[0].shape
    low, high = np.quantile(root[known], [_TAIL, 1 - _TAIL])
    width = max(float(high - low), 1e-9) / _BINS
    bins = np.clip((root - low) / width, 0, _BINS - 1).astype(np.intp)
    squares = np.arange(root[0].size).reshape(shape)
    votes = np.bincount((squares * _BINS + bins)[known], minlength=root[0].size * _BINS).reshape(-1, _BINS)
    blur = max(float(np.median(seen.std[known])) / width, 0.5)
    smooth = cv2.GaussianBlur(votes.astype(np.float32), (0, 0), sigmaX=blur, sigmaY=1e-6, borderType=cv2.BORDER_CONSTANT)
    usual = ((smooth.argmax(axis=1) + 0.5) * width + low).reshape(shape)
    for _ in range(2):
        near = known & (np.abs(root - usual) < _NEAR * np.hypot(seen.std, _UNEVEN * usual))
        weight = np.where(near, 1 / np.where(known, seen.std, 1) ** 2, 0)
        total = weight.sum(axis=0)
        usual = np.where(total > 0, (weight * root).sum(axis=0) / np.maximum(total, 1e-9), usual)
    return np.asarray(usual, np.float32), near.sum(axis=0) >= _USUAL * known.sum(axis=0)


def _squares(seen: _Seen, usual: FluxImage, misplaced_px: float) -> FluxImage:
    """Return the squared difference of squares from the usual, in variances; NaN where they are not seen: (S, h, w)."""
    slopes = np.square(gradient_of(usual)).sum(axis=0)
    tolerated = (_UNEVEN * usual) ** 2 + (misplaced_px / CELL_PX) ** 2 * slopes
    return np.where(seen.known, (seen.root - usual) ** 2 / (np.where(seen.known, seen.std, 1) ** 2 + tolerated), np.nan)


def _deviation(squares: FluxImage, known: BoolArray) -> FluxImage:
    """Return by how much squares and those around them differ from the usual, in standard deviations of noise: (S, h, w)."""
    # What frames sample of a thin line differs more, always.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # squares that are never seen
        always = np.maximum(np.nanmedian(squares, axis=0) / _MEDIAN, 1)
    found = np.zeros_like(squares)
    for index, (of_sum, there) in enumerate(zip(np.nan_to_num(squares / always), known, strict=True)):
        total, number = (cv2.filter2D(each, -1, _AROUND, borderType=cv2.BORDER_CONSTANT) for each in (of_sum, there * 1.0))
        found[index] = (total - number) / np.sqrt(2 * np.maximum(number, 1))
    return found


def _changing(squares: FluxImage, shown: BoolArray) -> BoolArray:
    """Return the places that change even where no patch hides them, as where something near shifts all the time: (h, w)."""
    number = shown.sum(axis=0)
    known = np.asarray(number >= _FEWEST_SEEN)
    mean = np.where(shown, squares, 0).sum(axis=0) / np.maximum(number, 1)
    total, there = (uniform_filter(each, _TOGETHER, mode="constant") for each in (np.where(known, mean, 0.0), known * 1.0))
    around = np.where(known, total / np.maximum(there, 1e-9), 0)
    usual = max(float(np.median(mean[known])), _STEADY) if known.any() else _STEADY
    return np.asarray(around > max(_CHANGING * usual, float(np.quantile(around, 1 - _MOST_CHANGING))))


def _patches(deviation: FluxImage, known: BoolArray, tolerance: _Tolerance) -> BoolArray:
    """Return the patches of squares that hide the background: (h, w)."""
    differs, side = known & (deviation > tolerance.beside), tolerance.thick
    # Errors of the motion differ along edges, which are thin.
    thick = cv2.morphologyEx((differs | ~known).astype(np.uint8), cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
    _, labels = cv2.connectedComponents((differs & (cv2.dilate(thick, np.ones((3, 3), np.uint8)) > 0)).astype(np.uint8))
    sure = np.bincount(labels[known & (deviation > _SURE)], minlength=labels.max() + 1) >= _FEWEST
    sure[0] = False
    return np.asarray(sure[labels])


def _seen_somewhere(hidden: BoolArray, deviation: FluxImage, known: BoolArray) -> BoolArray:
    """Return what is hidden, but not where a square always is: the sums that differ least are taken for the background."""
    least, never = hidden.copy(), known.any(axis=0) & (hidden | ~known).all(axis=0)
    for row, column in np.argwhere(never):
        times = np.flatnonzero(known[:, row, column])
        series = uniform_filter1d(deviation[times, row, column], _SMOOTH, mode="nearest")
        least[times[series <= np.quantile(series, _LEAST_HIDDEN)], row, column] = False
    return least


def _beyond_borders(hidden: BoolArray, known: BoolArray) -> BoolArray:
    """Return what is hidden, and squares beside it of which too little is seen: (S, h, w)."""
    beside = np.array([cv2.dilate(each, np.ones((5, 5), np.uint8)) for each in hidden.astype(np.uint8)]) > 0
    return np.asarray(hidden | (beside & ~known))


def _in_frames(source: Source, seen: _Seen, hidden: BoolArray) -> BoolArray:
    """Return the cells of the frames that hidden squares cover: (S, h', w')."""
    cells = []
    for image, places in zip(hidden, places_of_cells(source, seen.canvas, seen.motions), strict=True):
        x, y = np.moveaxis(places.astype(np.float32) / 2 - np.float32(0.5), -1, 0)
        cells.append(cv2.remap(image.view(np.uint8), x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0)
    return np.array(cells)


def places_of_cells(source: Source, canvas: Canvas, motions: FloatArray) -> Iterator[FloatArray]:
    """Yield where the middles of the cells of frames lie on a canvas, far off it where they are behind its plane: (h, w, 2)."""
    height, width = source.info.frame_shape
    rows, columns = (np.arange(0, side, CELL_PX) + (CELL_PX - 1) / 2 for side in (height, width))
    middles = np.stack(np.meshgrid(np.minimum(columns, width - 1), np.minimum(rows, height - 1)), axis=-1)
    camera = capture_of(source).camera
    ideal = middles if camera is None else camera.ideal(middles)
    ideal = np.concatenate([ideal, np.ones((*ideal.shape[:2], 1))], axis=-1)
    for motion in motions:
        yield np.nan_to_num(canvas.pixels(ideal @ (canvas.plane_to_rays @ motion).T), nan=-1e6)


def write_background(folder: Path, background: Background) -> None:
    """Write layers.npz into a folder."""
    arrays: dict[str, Any] = {name: getattr(background, name) for name in _ARRAYS}
    np.savez_compressed(folder / LAYERS_FILE, **arrays)


def before_background_of(source: Source, folder: Path) -> Source:
    """Return a capture without what hides the background by a run folder; as it is, if the run found nothing.

    Raises:
        InputError: layers.npz is damaged, or of frames of another size.
    """
    path, shape = folder / LAYERS_FILE, source.info.frame_shape
    if not path.exists():
        return source
    with reading(path, "cannot be read as the layers of a run; run again"), np.load(path, allow_pickle=False) as archive:
        instants, shown, filled = (archive[name] for name in _ARRAYS)
    expected = len(instants), *(-(-side // CELL_PX) for side in shape)
    if not shown.shape == filled.shape == expected:
        raise InputError(f"{path} has cells of the shape {shown.shape}, not {expected} as the capture; run again")
    return with_background(source, Background(instants, shown, filled, shape))


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
            image &= cv2.erode(self.painted(each, np.ones_like(cells)), _BESIDE_BORDERS).astype(np.uint8)
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
            if border**2 <= _CUT_BY_BORDER * patch.sum():
                found.append((instant, patch))
    sizes = np.array([patch.sum() for _, patch in found], int)
    usual = np.median(sizes.repeat(sizes)) if found else 0  # of most of what is hidden
    return [each for each, size in zip(found, sizes, strict=True) if usual / _SIZES < size < usual * _SIZES]
