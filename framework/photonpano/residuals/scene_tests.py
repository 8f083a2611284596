"""Tests of what was captured, and of whether the motion is that of the scene, not of the sensor or of what stands before it."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from photonpano.geometry import corners, transform_points
from photonpano.motion.timeline import INTERLACED, SHOTS, SHUFFLED
from photonpano.residuals.block_sums import M, V
from photonpano.residuals.residual_tests import changing_places
from photonpano.residuals.tested_run import RIVAL, TestedRun, Tests
from photonpano.values.verdict import Found

_STILL_PX = 1.0  # an image that moves by less over the capture stands still
_SMOOTH_PX = 8.0  # standard deviation of the Gaussian that takes the light of the scene out of its image
_FINE, _COARSE = (0.35, 0.5), (0.1, 0.17)  # cycles per pixel
MUCH = 0.25  # share of the frames that is left out, or of the panorama that changes, which may be the scene

SCENE_TESTS = Tests()


@SCENE_TESTS.doubtful_above(
    1,
    "the capture holds shots that no pair of exposures ties together, and the panorama is of the longest alone",
    "look at the panoramas of the others beside the run folder: DIR.panorama-2 and so on",
)
def _shots(run: TestedRun) -> Found | None:
    shots = next((str(each.value) for each in run.decisions if each.what == SHOTS), "")
    return Found(shots.count("frame"), shots) if shots else None


@SCENE_TESTS.doubtful_above(
    0.5,
    "odd and even frames show two different images, as where two captures are interlaced",
    "write each capture to a file of its own",
)
def _interlaced(run: TestedRun) -> Found | None:
    return run.decided(INTERLACED, "share of the image in which they differ")


@SCENE_TESTS.doubtful_above(
    0.05,
    "the image jumps back and forth from one frame to the next, as where frames are out of order",
    "sort the frames by the time at which they were taken",
)
def _shuffled(run: TestedRun) -> Found | None:
    return run.decided(SHUFFLED, "share of the width of a frame, the median of the jumps")


@SCENE_TESTS.doubtful_above(
    10,
    "the photons contradict the focal length or the lens that the spec gives",
    "write camera: {focal_px: find}, and distortion: {k1: find} if the lens distorts, or calibrate the camera anew",
)
def _given_camera(run: TestedRun) -> Found | None:
    freed = run.levels[-1].located.solution.freed() if run.levels else None
    if freed is None:
        return None
    what, unit = [("a focal length", " px"), ("k1", "")][freed.number]
    where = f"{what} of {freed.found:.4g} ± {freed.std:.2g}{unit} fits, {freed.given:.4g}{unit} is given; in expected errors"
    return Found(abs(freed.found - freed.given) / freed.std, where)


@SCENE_TESTS.doubtful_above(
    1.0,
    "parts of the frame follow another motion than the one that was found",
    "mask what does not belong to the scene (corrections: mask); the motion may be that of either part",
)
def _two_motions(run: TestedRun) -> Found | None:
    return run.decided(RIVAL)


@SCENE_TESTS.doubtful_above(
    0.5,
    "the image stands still, and has the fine grain of a sensor whose pixels differ",
    "divide by a flat field (corrections: flat-field); what was found to stand still may be the sensor, and not the scene",
)
def _grain(run: TestedRun) -> Found | None:
    residuals, motion = run.explained.residuals, run.explained.motion
    middle = corners(residuals.frame_shape).mean(axis=0)
    places = transform_points(motion.homographies[motion.located], middle[None])[:, 0]
    if np.ptp(places, axis=0).max() > _STILL_PX:
        return None
    # A lens blurs what it images, so that waves of two or three pixels are weak; the grain of pixels is white.
    counts = np.nan_to_num(residuals.pixel_gain * residuals.pixel_mean)
    image = counts / np.maximum(ndimage.gaussian_filter(counts, _SMOOTH_PX), 1e-9)
    window = np.outer(*(np.hanning(size + 2)[1:-1] for size in image.shape))
    power = np.abs(np.fft.rfft2(window * (image - np.average(image, weights=window)))) ** 2 / (window**2).sum()
    sums = residuals.blocks[..., [V, M]].sum(axis=(0, 1))
    noise = sums[0] / max(sums[1], 1e-9) / max(float(counts.mean()), 1e-9)
    cycles = np.hypot(np.fft.fftfreq(image.shape[0])[:, None], np.fft.rfftfreq(image.shape[1]))
    fine, coarse = (float(power[(low < cycles) & (cycles < high)].mean()) - noise for low, high in (_FINE, _COARSE))
    return Found(max(fine, 0.0) / max(coarse, 1e-9), "power of waves of 2 to 3 px, relative to those of 6 to 10 px")


@SCENE_TESTS.doubtful_above(
    0.5,
    "more than half of the frame stands still while the rest moves",
    "mask what stands in the frame (corrections: mask); the motion may be that of either part",
)
def _standing(run: TestedRun) -> Found | None:
    return run.decided("standing_share", "share of the parts that show motion or rest")


@SCENE_TESTS.doubtful_above(
    0.5,
    "much of what the frames show does not follow one turn of the camera, as where it travels past near things",
    "keep away from what is near, or ask for the poses of a camera that travels (pose); the motion may be that of either part",
)
def _layers(run: TestedRun) -> Found | None:
    # Later levels leave out what is near.
    parallax = max((each.located.solution.parallax for each in run.levels), default=0.0)
    where = "share of the frames that is left out, on average"
    if parallax:
        where += f"; if what is near stands still, the camera travelled by about {parallax:.1g} of its distance"
    if (found := run.decided("movers", where)) is None:
        return None
    # Where little is left out, but much changes that is not, what is left out may be the scene.
    changing_share, _ = changing_places(run.explained.residuals)
    if min(found.figure, changing_share) <= MUCH:
        return found
    return found._replace(doubtful=True, where=f"{found.where}; {changing_share:.0%} of the panorama changes all the same")


@SCENE_TESTS.doubtful_above(
    0.35,
    "the background of much of the panorama was never seen, as where one thing fills the middle of all frames",
    "record so that each place is seen without what hides it; the motion may be that of what fills the frames",
)
def _never_seen(run: TestedRun) -> Found | None:
    return run.decided("background_never_seen", "share of the panorama")


def of_either_part(run: TestedRun) -> bool:
    """Return whether the motion may be that of either of two parts of the frames, and nobody can know from these which."""
    return any(test.judged(run) for test in (_grain, _standing, _layers))
