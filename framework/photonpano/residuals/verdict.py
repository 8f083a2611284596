"""The verdict on a run: whether motion and panorama explain the photons, by a table of tests.

Few tests decide: the halves of the capture agree, the photons are as the panorama predicts, the motion is known to a pixel, no
freer motion is likelier, and it is that of the scene. What else is found names the cause of a doubt, or is a note.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from photonpano.geometry import corners, transform_points
from photonpano.motion.loop import TOO_NARROW, LevelResult
from photonpano.residuals.block_sums import M, V
from photonpano.residuals.causes import CAUSES, TestedRun, Tests, changing_places
from photonpano.residuals.findings import NOTHING, Findings
from photonpano.residuals.measure import FEWEST_FRAMES
from photonpano.residuals.refinement import FEWEST_SPANS, Explained
from photonpano.text import listed, pixels
from photonpano.values import Verdict
from photonpano.values.verdict import Found, Test, judged

NARROW = "the camera moves by more than the model of its motion holds"
REPEATS = "the scene repeats, and pairs of exposures fit at several places"
_FIND_LENS = "camera: {distortion: {k1: find}}"  # what a spec says to measure the lens
MUCH = 0.25  # share of the panorama that changes, beyond which what is left out may be the scene
MAX_CONTRAST = 0.05  # up to this share of the light, what the panorama does not explain does not matter
_UNCERTAIN_PX = 1.0
_PARTS_CHANCE = 0.001  # of parts that noise sets apart
_SURE_SIGMAS = 6.0  # from which on what neighbouring frames have in common is no noise
_ASLANT = 5.0  # ratio of the errors along two directions beyond which one of them is unknown
_AMBIGUOUS = 0.05  # share of the pairs of a level that fit at several places; one or two may be by their noise
_STILL_PX = 1.0  # an image that moves by less over the capture stands still
_SMOOTH_PX = 8.0  # standard deviation of the Gaussian that takes the light of the scene out of its image
_FINE, _COARSE = (0.35, 0.5), (0.1, 0.17)  # cycles per pixel

FACTS, AGREEMENT = Tests(), Tests()


def judge(explained: Explained, levels: Sequence[LevelResult], findings: Findings = NOTHING) -> Verdict:
    """Test the result of a run; `levels` are empty if they are not known."""
    figures = explained.ratio, float(explained.residuals.reduced_chi2.mean())
    ratio, reduced_chi2 = (each if np.isfinite(each) else None for each in figures)
    return replace(judged(TESTS, TestedRun(explained, levels, findings), ratio), reduced_chi2=reduced_chi2)


@FACTS.doubtful_above(
    1,
    "the capture holds shots that no motion ties together, and the panorama is of the longest alone",
    "look at the panoramas of the others beside the run folder: DIR.panorama-2 and so on",
)
def _shots(run: TestedRun) -> Found | None:
    shots = run.findings.shots
    return Found(len(shots), listed(map(str, shots))) if shots else None


@FACTS.doubtful_above(
    0,
    "the image jumps while frames show nothing, so that it is unknown where they lie, and whether frames are missing",
    "keep the light on while the camera moves",
)
def _jump_in_the_dark(run: TestedRun) -> Found:
    found = [str(cut.dark) for cut in run.findings.cuts if cut.dark is not None]
    return Found(len(found), ", ".join(found))


@FACTS.doubtful_above(
    0,
    "no test of the motion can be made, since the capture is too short",
    "record more frames, or compare the panorama with what you know of the scene",
)
def _untested_motion(run: TestedRun) -> Found:
    residuals, ratio = run.explained.residuals, run.explained.ratio
    known = np.isfinite(ratio) or max(map(len, residuals.spans)) >= FEWEST_FRAMES
    where = f"spans that are missing: the scatter of shifts needs {FEWEST_SPANS} spans, and {len(residuals.spans)} are there"
    return Found(0 if known else max(FEWEST_SPANS - len(residuals.spans), 1), where)


@FACTS.doubtful_above(
    0.5,
    "much of what the frames show does not follow one turn of the camera",
    "the motion may be that of either part",
)
def _layers(run: TestedRun) -> Found | None:
    rival = run.findings.rival_motion
    if run.findings.hidden_share is None or (rival is not None and rival.px > _UNCERTAIN_PX):
        return None
    found = Found(run.findings.hidden_share, "share of the frames that is left out, on average")
    if parallax := parallax_of(run):
        what = f"the camera travels by about {parallax:.1g} of the distance of what is near, and much of the frames shows that"
        what_to_do = "keep away from what is near, or write pose: to find the path of the camera in place of a panorama"
        found = found._replace(what=what, what_to_do=what_to_do)
    # Where little is left out, but much changes that is not, what is left out may be the scene.
    changing_share, _ = changing_places(run.explained.residuals)
    if min(found.figure, changing_share) <= MUCH:
        return found
    return found._replace(doubtful=True, where=f"{found.where}; {changing_share:.0%} of the panorama changes all the same")


def parallax_of(run: TestedRun) -> float:
    """Return how far the camera travelled, over the distance of what is near; 0 where that does not rest."""
    # Later levels leave out what is near.
    return max((each.located.solution.parallax for each in run.levels), default=0.0)


@FACTS.doubtful_above(
    0.2,
    "parts of the sensor see the scene at different places, so that the panorama is torn",
    "the sensor may be read in another order than its frames are given in, or in parts one after the other",
)
def _parts(run: TestedRun) -> Found | None:
    """As where rows take turns, or a part of the sensor is read out some frames later than the rest."""
    apart = run.explained.residuals.apart
    if apart is None or apart.chance > _PARTS_CHANCE:
        return None
    if run.findings.rival_motion is not None or _standing.judged(run):  # a thing in the frame moves, or stands, by itself
        return None
    late = f", as if read {apart.frames:.2g} frames apart" if apart.frames else ""
    return Found(apart.px, f"px between {apart.parts}{late}")


@FACTS.doubtful_above(
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


@FACTS.doubtful_above(TOO_NARROW, NARROW, "write motion: {model: homography}")
def _narrow(run: TestedRun) -> Found | None:
    """Homographies are likelier, and farther away than the motion is expected to err."""
    if not run.levels or not (times := run.levels[-1].narrow):
        return None
    located = run.levels[-1].located
    model = located.solution.model
    apart_px = located.rivals["homography"].apart_px
    where = f"times the expected error lie between {model.name} and any homographies, which are likelier: {pixels(apart_px)} px"
    return Found(times, where)


@FACTS.doubtful_above(
    0.002,  # half of this is seen without a lens
    "the lens distorts the frames, which bends the motion",
    "undistort the frames before",
)
def _lens(run: TestedRun) -> Found | None:
    found = run.explained.lens
    if found is None or _parts.judged(run):  # a part that lies apart bends frames, too
        return None
    camera, what_to_do = run.explained.motion.camera, ""
    if camera is not None:
        what_to_do = "calibrate the lens, and write camera.distortion" if camera.distorts else f"write {_FIND_LENS}"
    elif not run.levels or "rotation" not in run.levels[-1].located.rivals:  # of which none through a lens was likelier
        what_to_do = f"write motion: {{model: rotation}} and {_FIND_LENS} for a camera that only turns"
    return Found(abs(found.k1), f"about {found.k1:.1%} at the corners", what_to_do=what_to_do)


@FACTS.doubtful_above(
    _UNCERTAIN_PX,
    "the expected error of the motion is large",
    "use more light",
)
def _uncertain(run: TestedRun) -> Found | None:
    """The motion is not known to a pixel: where two are possible, a direction is not seen, or there is too little light."""
    motion, levels = run.explained.motion, run.levels
    known = motion.std_px[motion.located]
    if not len(known) or not np.isfinite(known).all():
        alone = Found(0.0, "a single exposure was located", doubtful=True, what="no motion is known")
        return None if of_either_part(run) else alone
    if _narrow.judged(run) or _parts.judged(run):  # their distance is in the expected error
        return None
    for found in (_two_motions(run), _uncut_jump(run), _ambiguous(run), _one_direction(run)):
        if found is not None and found.figure > _UNCERTAIN_PX:
            return found
    if _layers.judged(run):  # the way of what is near is in the expected error
        return None
    beside_px = float(known.mean())
    if levels:  # a long path bends, which neither blurs nor tears a panorama
        located = levels[-1].located
        assessed = min(float(np.mean(located.std_px**2) / np.mean(known**2)), 1.0)
        beside_px *= float(np.sqrt(1 - located.drift_share * assessed))
    where = f"px on average, most at frame {np.argmax(np.where(motion.located, motion.std_px, 0))}"
    change_px = levels[-1].change_px if levels else None
    if change_px is not None and change_px > _UNCERTAIN_PX:
        where += f"; the last level changed the motion by {pixels(change_px)} px"
    return Found(beside_px, where)


def _two_motions(run: TestedRun) -> Found | None:
    what = "parts of the frame follow another motion than the one that was found"
    what_to_do = "the motion may be that of either part"
    rival = run.findings.rival_motion
    return None if rival is None else Found(rival.px, rival.where, what=what, what_to_do=what_to_do)


def _uncut_jump(run: TestedRun) -> Found | None:
    what = "the image seems to jump, but the photons contradict a cut of the motion there"
    what_to_do = "look at the path in the report around this frame"
    jump = run.findings.uncut_jump
    return None if jump is None else Found(jump.px, jump.where, what=what, what_to_do=what_to_do)


def _ambiguous(run: TestedRun) -> Found | None:
    for result in run.levels:
        ambiguity, n_edges = result.located.ambiguity, len(result.located.edges)
        if ambiguity is not None and len(ambiguity.pairs) > max(2, _AMBIGUOUS * n_edges):
            where = f"px to the second place; {len(ambiguity.pairs)} of {n_edges} pairs of level {result.level.number}"
            what_to_do = "look at the path in the report; a slower motion tells the places apart"
            return Found(ambiguity.alternative_px, where, what=REPEATS, what_to_do=what_to_do)
    return None


def others_px(run: TestedRun) -> float:
    """Return how far away motions are that jump, are along a second place, or that of a part of the sensor that lies apart.

    Rows that take turns see the same motion: what lies between them tears the panorama alone.
    """
    apart = run.explained.residuals.apart
    found = _uncut_jump(run), _ambiguous(run), None if apart is None or apart.turns else _parts.judged(run)
    return float(np.linalg.norm([each.figure for each in found if each is not None]))


def _one_direction(run: TestedRun) -> Found | None:
    halves = run.explained.halves
    if not len(halves.cuts.firsts):
        return None
    ties = halves.cuts, halves.stretches
    between = "the frames before and after {:.0f}", "frames {:.0f} to {:.0f} and all others"
    aslant = [np.where(weak >= _ASLANT * strong, weak, 0) for strong, weak in (each.std_px.T for each in ties)]
    found, place, weak_px = max(zip(ties, between, aslant, strict=True), key=lambda each: float(each[2].max()))
    weakest = int(np.argmax(weak_px))
    (strong, weak), angle = found.std_px[weakest].tolist(), found.angles_deg[weakest]
    if not weak_px[weakest]:
        return None
    ends = np.append(found.firsts[1:], run.explained.motion.span.stop) - 1
    where = f"px between {place.format(found.firsts[weakest], ends[weakest])}, at {angle:.0f} degrees from x towards y"
    what_to_do = (
        "the motion may be wrong by any distance along it, which this panorama does not show; keep other structures in view"
    )
    what = "the image says nothing of motion along one direction"
    return Found(weak, f"{where}; {pixels(strong)} px across it", what=what, what_to_do=what_to_do)


@FACTS.doubtful_above(
    0.5,
    "the image stands still, and has the fine grain of a sensor whose pixels differ",
    "what was found to stand still may be the sensor, and not the scene",
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


@FACTS.doubtful_above(
    0.1,
    "pixels that take turns count differently, as behind a colour filter that is not known, or shifted by a pixel",
    "name the pattern of the filter, from the first pixel of a frame on (corrections: colour-filter)",
)
def _alternating(run: TestedRun) -> Found | None:
    residuals = run.explained.residuals
    counts, phases = np.nan_to_num(residuals.pixel_gain * residuals.pixel_mean), [(y, x) for y in (0, 1) for x in (0, 1)]
    seen = [float(residuals.pixel_mean[y::2, x::2].sum()) for y, x in phases]
    if not all(seen):
        return None
    gains = [float(counts[y::2, x::2].sum()) / there for (y, x), there in zip(phases, seen, strict=True)]
    (x, y), (other_x, other_y) = (phases[index(gains)][::-1] for index in (np.argmax, np.argmin))
    return Found(max(gains) - min(gains), f"of the light, from pixel ({x}, {y}) of each 2x2 to pixel ({other_x}, {other_y})")


@FACTS.doubtful_above(
    0.5,
    "more than half of the frame stands still while the rest moves",
    "the motion may be that of either part",
)
def _standing(run: TestedRun) -> Found:
    return Found(run.findings.standing_share, "share of the parts that show motion or rest")


def of_either_part(run: TestedRun) -> bool:
    """Return whether the motion may be that of either of two parts of the frames, and nobody can know from these which."""
    return any(test.judged(run) for test in (_grain, _standing, _layers))


@AGREEMENT.doubtful_above(
    3.0,
    "the frames before and after an instant do not agree along the motion that was found",
    "look at the halves and the path in the report; the motion may be wrong, or the scene changes",
)
def _halves(run: TestedRun) -> Found | None:
    cuts = run.explained.halves.cuts
    if not np.isfinite(cuts.coherence).any():
        return None
    least = int(np.nanargmin(cuts.coherence))
    where = (
        "standard errors that the coherence lacks to 1, median over the instants; "
        f"least is {cuts.coherence[least]:.3g}, before frame {cuts.firsts[least]:.0f}"
    )
    return Found(run.explained.halves.disagreement, where)


@AGREEMENT.doubtful_above(
    0.1,
    "neighbouring frames have in common what the motion and the panorama do not show",
    "the motion may return within groups, or something stands in the frame",
)
def _neighbours(run: TestedRun) -> Found | None:
    lasting = run.explained.lasting
    if lasting is None or lasting.sigmas < _SURE_SIGMAS:
        return None
    where = f"of the contrast, in spans of {lasting.frames} frames, {lasting.sigmas:.0f} standard deviations"
    return Found(lasting.share, where)


@AGREEMENT.doubtful_above(
    1.1,
    "the panorama does not explain the photons: they differ from its prediction by more than their noise",
    "look at the maps of the report; the motion may be wrong, or the scene changes",
)
def _photons(run: TestedRun) -> Found | None:
    residuals = run.explained.residuals
    reduced_chi2 = float(residuals.reduced_chi2.mean())
    sums = residuals.blocks.sum(axis=(0, 1))
    per_span = sums / max(len(residuals.spans), 1)
    n = max(float(np.count_nonzero(residuals.blocks[..., V])), 1)
    # The squared residual of a block beyond its variance, as a part of its photons.
    contrast = float(np.sqrt(max(reduced_chi2 - 1, 0) * per_span[V] / n) / max(per_span[M] / n, 1e-9))
    return Found(reduced_chi2, f"on average by {contrast:.0%} of the light") if contrast > MAX_CONTRAST else None


# What is a fact, or is not known to a pixel; causes; and whether all agrees. The most telling are listed first.
TESTS: tuple[Test[TestedRun], ...] = (*FACTS, *CAUSES, *AGREEMENT)
