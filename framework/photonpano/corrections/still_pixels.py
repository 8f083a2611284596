"""Find what stands still in the frame while the rest of it moves: hot and dead pixels, windows, dirt; and mask it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from photonpano.capture import Capture, capture_of
from photonpano.corrections.applying import corrected_source
from photonpano.corrections.colour_filter import ColourFilter
from photonpano.corrections.dark import brightest, outliers, reach_of, sorted_neighbours
from photonpano.corrections.geometry import Correction
from photonpano.filtering import gradient_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from photonpano.contracts.protocols import Source
    from photonpano.corrections.geometry import Decide, Pixels
from photonpano.values import BoolArray, FluxImage, Still

_SPANS, _SPAN_FRAMES = 32, 128  # 32 spans of at most 128 frames are summed all over the capture
_THRESHOLD = 6.0  # smallest deviation of a hot or dead pixel from its neighbours, in robust standard deviations
_BLUR_PX = 1.0  # standard deviation of the Gaussian blur against photon noise, px
_SIDE_PX = 15  # side of the square over which a pixel's variances are averaged, px
_LEAST_PIXELS = 40  # least connected pixels of a part that stands
_REACH_PX = 24  # what stands still is continued over flat parts, which show neither motion nor rest, up to this distance, px
_SURE = 4.0  # standard errors from which a variance is not chance
# A part stands if it moved by less than 0.1 px (root mean square), and by less than 0.7 px with certainty.
_MOVED_PX, _STOOD_PX = 0.7, 0.1
_CALM = 0.25  # most variance of a part that stands, with certainty, relative to that where the frame moves
_STEADY = 0.03  # most excess variance of a hot pixel over its neighbours, as a fraction of its squared deviation
_HALO = 0.2  # least fraction of a point's brightness in the pixels that touch it
_LEAST_MOVING = 0.01  # least share of a frame that moves, for the frame not to stand still
# Structure is compared if its squared gradient is at least this fraction of the variance where the frame moves. A sensor
# whose pixels differ by a few percent has less before a sky.
_FAINT = 0.005
_HALF = 0.5
_VARIED = 0.1  # most share of pixels that are lit in all frames, or in none, of a line of the sensor that varies
_SHARE_OF = "share of the frame that stands still, of the parts that show motion or rest"


class StillPixels(Correction):
    """Masks what stands still while most of the frame moves: hot and dead pixels, a window, dirt."""

    name: ClassVar[str] = "still-pixels"

    def applied(self, pixels: Pixels, capture: Capture, decide: Decide | None) -> Pixels:
        """Mask what stands still; see `Correction`. Frames of grey levels, whose noise is not known well, stay as they are."""
        n_frames = min(_SPAN_FRAMES, (capture.info.n_frames - 1) // _SPANS)
        if decide is None or capture.info.kind != "binary" or n_frames == 0:
            return pixels
        spans = capture.info.spread(_SPANS, n_frames)
        sums = np.stack([counts.ravel()[pixels.index].astype(np.uint8) for counts in capture.chunks(spans)])
        mask, share, why = find_still(sums, n_frames, pixels.valid & ~pixels.interpolated, pixels.alike())
        n_masked, n_pixels = int((mask & pixels.valid).sum()), int(pixels.valid.sum())
        still = Still(share, f"{n_masked / max(n_pixels, 1):.2%} of {n_pixels} pixels {why}")
        decide("still_pixels", n_masked, still.how)
        decide("standing_share", share, _SHARE_OF)
        return replace(pixels.without(mask), still=still)


def without_still_pixels(source: Source, look: bool = True) -> Capture:
    """Return a capture in which what stands still is masked.

    A capture of grey levels stays as it is, and one that corrects its sums itself, which cannot be corrected further. One that
    gives the Bayer array before its pixels is seen in colour. For `look`, see `corrected_source`.
    """
    capture = capture_of(source)
    corrections: list[Correction] = [] if capture.info.bayer is None else [ColourFilter(keep="all")]
    if capture.info.kind == "binary":
        corrections.append(StillPixels())
    if not corrections or capture.corrects_sums:
        return capture
    return corrected_source(capture, corrections, look=look)


def find_still(
    sums: NDArray[np.uint8], n_frames: int, usable: BoolArray, alike: Sequence[BoolArray]
) -> tuple[BoolArray, float, str]:
    """Find what stands still while the rest of the frame moves, from (M, H, W) sums of binary frames at M times of a capture.

    A pixel that sees one thing all the time varies by photon noise only; a pixel that the scene moves past varies by its
    contrast. To stand still, a part must have structure in all directions, which a motion would have turned into variation: a
    part that moves by s px (root mean square) over a mean squared gradient g varies by about g s^2. Single pixels stand if they
    differ from their neighbours all the time.

    Pixels of each mask in `alike` may be compared with each other, such as those of one colour. The parts are those that most
    of the pixels show.

    Returns the (H, W) mask of the pixels to mask, the share of the frame that stands still, 0 if none moves, and a clause on
    the masked pixels.
    """
    import cv2

    colours = [usable & part for part in alike]
    single = np.logical_or.reduce([_single_pixels(sums, n_frames, part) for part in colours])
    lines, of_lines = _silent_lines(sums.sum(axis=0, dtype=np.int64), len(sums) * n_frames, usable)
    single |= lines
    moving, stood = _parts(sums, n_frames, max(colours, key=np.count_nonzero) & ~single)
    standing = _continued(stood, ~moving)
    n_standing, n_moving = int(standing.sum()), int((moving & ~standing).sum())
    share = n_standing / max(n_standing + n_moving, 1)
    if moving.mean() < _LEAST_MOVING:
        return np.zeros_like(usable), 0.0, "are masked: nothing in the frame moves"
    if share > _HALF:
        why = f"are masked: {share:.0%} of the frame stands still, so that it is open which part is the scene"
        return np.zeros_like(usable), share, why
    side = 2 * (_SIDE_PX // 2 + 2) + 1  # a square that reaches over the edge of what stands shows motion
    mask = (single | (cv2.dilate(standing.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)) & usable
    where = f"in {len(sums) * n_frames} frames sampled all over the capture"
    return mask, share, f"stand still {where}, while the rest moves{of_lines}"


def _single_pixels(sums: NDArray[np.uint8], n_frames: int, usable: BoolArray) -> BoolArray:
    """Return the hot and dead pixels: they differ from their neighbours, and vary hardly more than these."""
    n_spans, total = len(sums), len(sums) * n_frames
    counts = sums.sum(axis=0, dtype=np.float32)
    stabilised = np.arcsin(np.sqrt((counts + 0.375) / np.float32(total + 0.75)))
    nothing = np.float32(np.nan)
    found = outliers(np.where(usable, stabilised, nothing), 0.5 / np.sqrt(total), _THRESHOLD)
    mean = counts / np.float32(total)
    noise = _photon_noise(mean, n_frames, total)
    variance = sum((each / np.float32(n_frames) - mean) ** 2 for each in sums) / np.float32(n_spans - 1)
    difference, more = (_beyond_neighbours(np.where(usable, image, nothing)) for image in (mean, variance - noise))
    chance = _SURE * np.sqrt(2 / (n_spans - 1)) * noise
    return np.asarray(found & (more < chance + _STEADY * difference**2) & ~_has_halo(np.nan_to_num(difference)))


def _silent_lines(counts: NDArray[np.int64], total: int, usable: BoolArray) -> tuple[BoolArray, str]:
    """Return the rows and columns of which each pixel is lit in all frames, or in none, beside lines that vary; and a clause.

    A dark sky ends at no line of the sensor: there, the next line is dark in part.
    """
    from scipy import ndimage

    silent, found, named = (counts == 0) | (counts == total) | ~usable, np.zeros_like(usable), []
    for name, along in (("rows", 1), ("columns", 0)):
        share = silent.mean(axis=along)
        for (run,) in ndimage.find_objects(ndimage.label(share == 1)[0]):
            beside = [share[each] for each in (run.start - 1, run.stop) if 0 <= each < len(share)]
            part = (slice(None), run) if along == 0 else run
            if beside and max(beside) < _VARIED and usable[part].any():
                found[part] = usable[part]
                named.append(f"{name} {run.start} to {run.stop - 1}")
                if name == "columns" and run.stop == len(share) and len(share) % 8 == 0 and run.stop - run.start < 8:
                    named[-1] += f", as where `width: {run.start}` is missing"
    return found, f"; all pixels are lit in all of them, or in none, of {'; '.join(named)}" if named else ""


def _beyond_neighbours(image: FluxImage) -> FluxImage:
    """Return the difference of each pixel from the median of its neighbours."""
    return np.asarray(image - brightest(sorted_neighbours(image, reach_of(image)), 0.5))


def _has_halo(difference: FluxImage) -> BoolArray:
    """Return where at least three of the four pixels that touch one share its difference: a lens blurs stars, not pixels."""
    height, width = difference.shape
    padded = np.pad(difference, 1)
    touching = [padded[1 + y : 1 + y + height, 1 + x : 1 + x + width] for y, x in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    third = np.sort(np.stack(touching) * np.sign(difference), axis=0)[1]
    return np.asarray(third > _HALO * np.abs(difference))


def _parts(sums: NDArray[np.uint8], n_frames: int, usable: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Return where the frame moves, and where it stands, (H, W) each; both are False where nothing shows it.

    Variation over time is compared with structure, averaged over squares.
    """
    kernel = _kernel()
    independent = _SIDE_PX**2 * _energy(kernel)
    mean, noise, variance = _variation(sums, n_frames, usable)
    chance = np.sqrt(2 / (len(sums) - 1) / independent) * _root_mean_square(noise)
    slope_noise = noise / len(sums) * float(np.sum(np.convolve(kernel, [0.5, 0, -0.5]) ** 2) / np.sum(kernel**2))
    structure = _weakest_structure(mean, slope_noise)

    moving = (variance > _SURE * chance) & (variance > structure)
    some_move = moving.mean() >= _LEAST_MOVING
    typical = float(np.median(variance[moving])) if some_move else 0.0
    noticed = _SURE * np.sqrt(2 / independent) * _root_mean_square(slope_noise)
    stood = (structure > np.maximum(noticed, _FAINT * typical)) & (variance < _STOOD_PX**2 * structure + _SURE * chance)
    certain = variance + 2 * chance < np.minimum(_MOVED_PX**2 * structure, _CALM * typical if some_move else np.inf)
    return moving, _large(stood & certain)


def _variation(sums: NDArray[np.uint8], n_frames: int, usable: BoolArray) -> tuple[FluxImage, FluxImage, FluxImage]:
    """Return mean and photon noise of the blurred sums per frame, and their variance over time without noise, over squares."""
    n_spans, total, known = len(sums), len(sums) * n_frames, usable.astype(np.float32)
    near = np.maximum(_blurred(known), np.float32(1e-3)) * n_frames

    def smooth(each: NDArray[np.uint8]) -> FluxImage:
        return np.asarray(_blurred(each * known) / near, np.float32)

    mean = np.asarray(sum(map(smooth, sums)) / n_spans, np.float32)
    light = [float(smooth(each).mean()) / max(float(mean.mean()), 1e-9) for each in sums]
    as_seen = sum((smooth(each) - mean) ** 2 for each in sums)
    relit = sum((smooth(each) - mean * np.float32(now)) ** 2 for each, now in zip(sums, light, strict=True))
    pixel_noise = _photon_noise(sums.sum(axis=0, dtype=np.float32) / np.float32(total), n_frames, total)
    noise = np.asarray(_blurred(pixel_noise * known) * (n_frames / near) ** 2 * _energy(_kernel()), np.float32)
    # Neither a change of light, nor the division by it, must look like motion.
    variance = np.minimum(*(_averaged(squares / np.float32(n_spans - 1) - noise) for squares in (as_seen, relit)))
    return mean, noise, variance


def _weakest_structure(mean: FluxImage, slope_noise: NDArray[Any]) -> FluxImage:
    """Return the mean squared gradient along the direction in which it is least, without that of noise: (H, W).

    A horizontal edge stays as it is while the camera pans along it, so the direction with the least structure counts.
    """
    down, across = (np.asarray(slopes, np.float32) for slopes in gradient_of(mean))
    xx, yy = _averaged(across**2 - slope_noise), _averaged(down**2 - slope_noise)
    return np.asarray((xx + yy) / 2 - np.hypot((xx - yy) / 2, _averaged(across * down)), np.float32)


def _photon_noise(mean: FluxImage, n_frames: int, total: int) -> FluxImage:
    """Return the variance of a sum of frames, divided by their number, from the mean of `total` frames."""
    return np.asarray(mean * (1 - mean) * np.float32(total / (total - 1) / n_frames), np.float32)


def _large(standing: BoolArray) -> BoolArray:
    """Return the connected parts that are larger than a few pixels, which may stand by chance."""
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(standing.astype(np.uint8))
    large = stats[:, cv2.CC_STAT_AREA] >= _LEAST_PIXELS
    large[0] = False
    return np.asarray(large[labels])


def _continued(standing: BoolArray, allowed: BoolArray) -> BoolArray:
    """Continue what stands over parts that do not move, up to `_REACH_PX`."""
    import cv2

    grown, square = standing.astype(np.uint8), np.ones((3, 3), np.uint8)
    for _ in range(_REACH_PX):
        grown = np.where(allowed, cv2.dilate(grown, square), grown)
    return grown > 0


def _kernel() -> NDArray[np.float64]:
    import cv2

    return np.asarray(cv2.getGaussianKernel(2 * round(4 * _BLUR_PX) + 1, _BLUR_PX), np.float64).ravel()


def _energy(kernel: NDArray[np.float64]) -> np.float32:
    """Return the fraction of the variance of white noise that a separable blur leaves."""
    return np.float32(np.sum(kernel**2) ** 2)


def _blurred(image: NDArray[Any]) -> FluxImage:
    import cv2

    return np.asarray(cv2.sepFilter2D(image.astype(np.float32), -1, _kernel(), _kernel()), np.float32)


def _root_mean_square(image: NDArray[Any]) -> FluxImage:
    """Return the root of the averaged squares: the standard error of an average of unequal variances depends on it."""
    return np.sqrt(np.maximum(_averaged(image**2), 0))


def _averaged(image: NDArray[Any]) -> FluxImage:
    import cv2

    return np.asarray(cv2.blur(image.astype(np.float32), (_SIDE_PX, _SIDE_PX)), np.float32)
