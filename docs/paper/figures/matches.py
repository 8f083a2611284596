"""Fig. 2: registration of two conventional frames over noise and blur: matches of SIFT, and errors of the locators."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import picture_parts as draw
from harness import Study
from numpy.typing import NDArray
from paper.figures.study import QUICK_STREET, Claim, Numbers, rounded

from photonpano import FrameSpan, Group, Located, StageContext, discover, open_source, parse_spec
from photonpano.geometry import FrameTrajectory, corner_displacements, inverse, transform_points

BLUR_PX = (0, 3, 6, 12, 20, 30)  # blur of the frames, which are 30 px apart
PHOTONS = (3000, 300, 100, 30, 10, 3)  # per pixel per frame, from little noise to much
LOCATORS = ("opencv-sift", "direct")
CORRECT_PX, LOST_PX = 3.0, 10.0  # largest error of a match that counts; the error with which a lost pair is drawn and averaged


def make(study: Study) -> tuple[draw.Picture, Numbers]:
    """Register the pairs of each blur and each noise."""
    every = slice(None, None, 3) if study.quick else slice(None)
    blurs, photons = BLUR_PX[every], PHOTONS[every]
    maps = {name: np.zeros((len(photons), len(blurs))) for name in ("matches", *LOCATORS)}
    for row, flux in enumerate(photons):
        for column, blur in enumerate(blurs):
            for name, value in registered(pairs_of(study, flux, blur))[0].items():
                maps[name][row, column] = value
    numbers: Numbers = {
        "blur_px": list(blurs),
        "photons": list(photons),
        "matches": maps["matches"].round().astype(int).tolist(),
        **{name: [[rounded(value, 2) for value in line] for line in maps[name]] for name in LOCATORS},
    }
    corners = {  # with little and much noise and blur
        f"{flux:,} photons, {blur} px of blur": draw.fitted(registered(pairs_of(study, flux, blur), pairs=0)[1], 238)
        for flux in (1000, 10)
        for blur in (0, 20)
    }
    return draw.in_rows([draw.in_colour(draw.beside(draw.all_labelled(corners))), heat_maps(numbers, 2 * 484 + 8)]), numbers


def pairs_of(study: Study, flux: float, blur: float) -> dict[str, Any]:
    """Return the spec of frames with so many photons per pixel and so many px of blur."""
    spec = study.spec("paper/fig2", {"source.with.flux": flux}, QUICK_STREET)
    spec["source"]["with"]["sensor"] |= {"exposure": blur / 30, "full_well": 4 * flux + 100}
    return spec


def registered(spec: dict[str, Any], pairs: int | None = None) -> tuple[dict[str, float], draw.Picture]:
    """Return the mean number of correct matches and the mean error of each locator, over neighbouring frames; and a frame."""
    plan = parse_spec(spec)
    found: dict[str, list[float]] = {name: [] for name in ("matches", *LOCATORS)}
    with open_source(plan) as source:
        assert hasattr(source, "truth")
        true, context = source.truth()["homographies"], StageContext(source.info, source.response)
        choice = plan.levels[0].merge
        merger = choice.contribution.build(choice.config, context)
        n_frames = source.info.n_frames if pairs is None else pairs + 1
        groups = [Group(FrameSpan(index, index + 1), float(index)) for index in range(n_frames)]
        exposures = [merger.merge(source, group, FrameTrajectory(true), 1.0) for group in groups]
        white = draw.white_of(exposures[0].flux)
        pictures = [draw.picture(each.flux, white) for each in exposures]
        locators = {name: discover().find("locator", name).contribution for name in LOCATORS}
        built = {name: each.build(each.config(), context) for name, each in locators.items()}
        features = {name: [locator.describe(each) for each in exposures] for name, locator in built.items()}
        for index in range(n_frames - 1):
            motion = inverse(true[index]) @ true[index + 1]
            found["matches"].append(correct_matches(pictures[index + 1], pictures[index], motion))
            for name, locator in built.items():
                located = locator.register(features[name][index + 1], features[name][index], None)
                error = LOST_PX
                if isinstance(located, Located):
                    error = float(corner_displacements(located.homography, motion, source.info.frame_shape).mean())
                found[name].append(min(error, LOST_PX))
    return {name: float(np.mean(values)) for name, values in found.items() if values}, pictures[0]


def correct_matches(moving: draw.Picture, fixed: draw.Picture, motion: NDArray[np.float64]) -> int:
    """Return how many matches of SIFT, by Lowe's ratio, agree with the true motion."""
    sift = cv2.SIFT.create()
    (first, first_words), (second, second_words) = (sift.detectAndCompute(image, None) for image in (moving, fixed))
    if len(first) < 2 or len(second) < 2:
        return 0
    pairs = cv2.BFMatcher().knnMatch(first_words, second_words, k=2)
    matches = [one for one, other in pairs if one.distance < 0.75 * other.distance]
    if not matches:
        return 0
    at = np.array([first[match.queryIdx].pt for match in matches])
    to = np.array([second[match.trainIdx].pt for match in matches])
    return int((np.linalg.norm(transform_points(motion, at) - to, axis=-1) < CORRECT_PX).sum())


def heat_maps(numbers: Numbers, width: int) -> draw.Picture:
    """Draw the matches and the errors over noise and blur."""
    figure, axes = draw.panels(width / 100, 3.4, 1, 3)
    titles = {"matches": "correct matches of SIFT", **{name: f"error of {name} (px)" for name in LOCATORS}}
    for panel, (name, title) in zip(axes, titles.items(), strict=True):
        values = np.array(numbers[name])
        scaled = np.log10(values + 1) if name == "matches" else -np.log10(values)
        panel.imshow(scaled, cmap="viridis")
        for (row, column), value in np.ndenumerate(values):
            text = "lost" if name != "matches" and value >= LOST_PX else f"{value:g}"
            panel.text(column, row, text, ha="center", va="center", fontsize=7, color="white", bbox=BOX)
        panel.set_xticks(range(len(numbers["blur_px"])), [str(each) for each in numbers["blur_px"]], fontsize=8)
        panel.set_yticks(range(len(numbers["photons"])), [f"{each:,}" for each in numbers["photons"]], fontsize=8)
        panel.set_title(title, fontsize=9)
        draw.name_axes(panel, "blur (px)", fontsize=8)
    axes[0].set_ylabel("photons per pixel: less is noisier", fontsize=8)
    return draw.in_bgr(figure)


BOX = {"facecolor": "black", "alpha": 0.35, "linewidth": 0, "pad": 1.0}  # behind the numbers of the heat maps


def claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 2."""
    matches = np.array(numbers["matches"])
    lost = {name: float((np.array(numbers[name]) >= CORRECT_PX).mean()) for name in LOCATORS}
    most, darkest, blurred = int(matches[0, 0]), int(matches[-1, 0]), int(matches[0, -1])
    return [
        Claim(
            "SIFT works with low noise and low motion blur",
            f"{most} correct matches at {numbers['photons'][0]:,} photons and {numbers['blur_px'][0]} px of blur",
            most > 100,
        ),
        Claim(
            "the number of successful matches drops at higher noise and blur",
            f"{darkest} at {numbers['photons'][-1]} photons, {blurred} at {numbers['blur_px'][-1]} px of blur, "
            f"{int(matches[-1, -1])} at both",
            max(darkest, blurred) < most / 5,
        ),
        Claim(
            "(not in the paper) our locators on the same frames",
            "; ".join(
                f"{name} is off by {CORRECT_PX:g} px or more in {share:.0%} of the fields" for name, share in lost.items()
            ),
        ),
    ]
