"""Figs. 3, 5, 6 and S2: what the levels do for a camera that trembles, with and without new groups."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import picture_parts as draw
from harness import Compared, Study
from numpy.typing import NDArray
from paper.figures.study import (
    Claim,
    Numbers,
    averaged_in_place,
    frames_of,
    group_size,
    levels_of,
    rounded,
    scores_of,
)

QUICK = {
    "source.with.path": {"kind": "random-spline", "length_px": 60, "shake": {"rms_px": 2.0, "frequencies_hz": [900, 1600]}},
    "source.with.scene": {"kind": "street", "width": 512, "height": 341, "seed": 3},
    "source.with.n_frames": 400,
    "source.with.frame_shape": [96, 128],
    "source.with.flux": 1,
    "resample.with.group_size": 50,
    "motion.model": "homography",  # what the figures compare, and no rotations
}
LEVELS = 3  # of Fig. 3, Fig. 5 and S2
COLOURS = ("#c8a26b", "#1f5a94", "#7a1f5a")  # of the levels
ENDS = 0.5  # length of an end of the capture, in groups


def runs(study: Study, **sections: object) -> tuple[Numbers, Path, list[Path]]:
    """Return how large the capture and its groups are, the capture, and the runs of one level, of two, and of three."""
    spec = study.spec("paper/fig6", {}, QUICK)
    capture = study.capture("fig6", spec)
    folders = [study.run("fig6", spec | {"levels": [{"scale": 1}] * n} | sections, capture) for n in range(1, LEVELS + 1)]
    return {**frames_of(spec, "flux"), "group_size": group_size(spec)}, capture, folders


def constant(study: Study, capture: Path) -> Path:
    """Return the run with a constant number of groups, which locates no end by itself."""
    return study.run("fig5", study.spec("paper/fig5", {}, QUICK), capture)


def loop(study: Study) -> tuple[draw.Picture, Numbers]:
    """Fig. 3: the estimated path, with expected errors, after each level."""
    settings, capture, folders = runs(study, refine=[])  # refiners correct the motion of one level, too
    rate = settings["frame_rate_hz"] / 1000
    figure, axes = draw.panels(10, 5.6, 2, LEVELS, sharex=True)
    levels: Numbers = {"error_px": [], "expected_px": [], "exposures": []}
    for column, (folder, colour, path, errors) in enumerate(zip(folders, COLOURS, axes, axes[LEVELS:], strict=False)):
        run = Compared.of(folder, capture)
        with np.load(folder / "exposures" / f"level-{column + 1}.npz") as level:
            spans, instants = level["frames"], level["instants"].round().astype(int)
        true, estimated = run.middles(true=True), run.aligned_middles()
        for start, stop in spans[:: 2 ** (column + 1)]:
            path.axvspan(start / rate, stop / rate, color=colour, alpha=0.2, linewidth=0)
        milliseconds = np.arange(len(true)) / rate
        path.plot(milliseconds, true[:, 0], color="0.6", linewidth=3, label="true path")
        path.plot(milliseconds, estimated[:, 0], color=colour, linewidth=1, label="estimated")
        path.set_title(f"level {column + 1}: {len(spans)} exposures", fontsize=10)
        error = (estimated - true)[:, 0]
        errors.plot(milliseconds, error, color=colour, linewidth=0.8)
        bars = {"fmt": ".", "color": "black", "markersize": 4, "linewidth": 0.8}
        errors.errorbar(instants / rate, error[instants], run.found.std_px[instants], **bars)
        draw.name_axes(errors, "ms")
        levels["error_px"].append(rounded(run.score.mean_px))
        levels["expected_px"].append(rounded(float(run.found.std_px[run.found.located].mean())))
        levels["exposures"].append(len(spans))
    axes[0].legend(fontsize=8)
    axes[0].set_ylabel("x (px)", fontsize=9)
    axes[LEVELS].set_ylabel("error of x, with expected errors (px)", fontsize=9)
    return draw.in_bgr(figure), settings | levels


def loop_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 3."""
    errors, expected = numbers["error_px"], numbers["expected_px"]
    return [
        Claim(
            "the estimated path converges to the true motion over several iterations",
            f"mean corner error by level: {', '.join(f'{each:g}' for each in errors)} px",
            errors[0] > errors[1] > errors[2],
        ),
        Claim(
            "the error bars on existing points get smaller in the second iteration",
            f"mean expected error by level: {', '.join(f'{each:g}' for each in expected)} px",
            expected[1] < expected[0],
        ),
        Claim(
            "new exposures are centred between those before",
            f"{', '.join(str(each) for each in numbers['exposures'])} exposures",
            numbers["exposures"][1] >= 2 * numbers["exposures"][0] - 1,
        ),
    ]


def without_new_groups(study: Study) -> tuple[draw.Picture, Numbers]:
    """Fig. 5: the panorama with a constant number of groups, and with new groups at each level."""
    numbers, capture, folders = runs(study)
    ways = {"constant number of groups": constant(study, capture), "new groups at each level": folders[-1]}
    compared = {name: Compared.of(folder, capture) for name, folder in ways.items()}
    few = compared["constant number of groups"]
    worst = int(np.argmax(np.where(inside(numbers), few.score.errors_px, 0)))
    figure, (panel,) = draw.panels(9.68, 2.6)
    shown = {}
    for (name, run), colour in zip(compared.items(), COLOURS, strict=False):
        panorama = run.panorama
        shown[name] = draw.place(panorama, run.middles()[worst], (120, 90), draw.white_of(panorama.flux))
        panel.plot(run.score.errors_px, color=colour, linewidth=1, label=name)
        numbers[name.split()[0]] = scores_of(run.folder, capture) | {"exposures": levels_of(run.folder, "groups")[-1]}
    draw.name_axes(panel, "frame", "corner error (px)")
    panel.legend(fontsize=8)
    return draw.in_rows([draw.beside(draw.all_labelled(shown)), draw.drawn(figure)[..., 0]]), numbers


def inside(settings: Numbers) -> NDArray[np.bool_]:
    """Return the frames that are more than a group from both ends: (T,)."""
    n_frames, group = settings["n_frames"], settings["group_size"]
    frames = np.arange(n_frames)
    return (frames >= group) & (frames < n_frames - group)


def groups_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 5."""
    few, many = numbers["constant"], numbers["new"]
    return [
        Claim(
            "without new virtual exposures at each level, the estimates of the path are unreliable",
            f"mean corner error {few['mean_px']:g} px with {few['exposures']} exposures at each level, {many['mean_px']:g} px "
            f"with {many['exposures']} at the last",
            few["mean_px"] > 2 * many["mean_px"],
        ),
        Claim(
            "this results in blur and ghosting artifacts",
            f"panorama {few['below_oracle_db']:z.1f} dB below the one along the true motion, with new groups "
            f"{many['below_oracle_db']:z.1f} dB",
            few["below_oracle_db"] > many["below_oracle_db"] + 1,
        ),
    ]


def refinement(study: Study) -> tuple[draw.Picture, Numbers]:
    """Fig. 6: averages of groups, and panoramas of one level and of two."""
    numbers, capture, folders = runs(study)
    naive, naive_db = averaged_in_place(folders[0], capture)
    first, second = (Compared.of(folder, capture) for folder in folders[:2])
    named = {f"averages of {numbers['group_size']:,} frames": naive, "one level": first.panorama}
    panoramas = {**named, "two levels": second.panorama}
    white = draw.white_of(second.panorama.flux)
    middles = second.middles()
    rows = {}
    for name, panorama in panoramas.items():
        insets = [draw.place(panorama, middles[frame], (60, 60), white) for frame in (0, len(middles) // 2)]
        whole = draw.picture(panorama.flux, white)
        scale = insets[0].shape[0] / whole.shape[0]
        rows[name] = draw.beside([draw.fitted(whole, round(whole.shape[1] * scale)), *insets])
    numbers["averages_psnr_db"] = round(naive_db, 1)
    return draw.in_rows(draw.all_labelled(rows)), numbers | {"levels": [scores_of(folder, capture) for folder in folders]}


def refinement_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of Fig. 6."""
    first, second, third = numbers["levels"]
    return [
        Claim(
            f"blurry regions become sharper: averages in groups (m = {numbers['group_size']:,}), then two iterations",
            f"PSNR {numbers['averages_psnr_db']:.1f} dB of the averages, {first['psnr_db']:.1f} dB after one level, "
            f"{second['psnr_db']:.1f} dB after two",
            numbers["averages_psnr_db"] < first["psnr_db"] < second["psnr_db"],
        ),
        Claim(
            "drift is corrected: the global shape of the panorama is rectified",
            f"largest corner error {first['worst_px']:g} px after one level, {second['worst_px']:g} px after two",
            second["worst_px"] < first["worst_px"],
        ),
        Claim(
            "two or three iterations are satisfactory",
            f"below the panorama along the true motion: {second['below_oracle_db']:z.1f} dB after two levels, "
            f"{third['below_oracle_db']:z.1f} dB after three",
            third["below_oracle_db"] < 1,
        ),
    ]


def ends(study: Study) -> tuple[draw.Picture, Numbers]:
    """S2: errors at the ends of the capture, where they are located and where they are extrapolated."""
    numbers, capture, folders = runs(study)
    length = int(ENDS * numbers["group_size"])
    figure, (panel,) = draw.panels(9.68, 3)
    numbers |= {"ends_px": {}, "between_px": {}}
    ways: dict[str, Any] = {"constant": constant(study, capture), **{f"level {n + 1}": each for n, each in enumerate(folders)}}
    for (name, folder), colour in zip(ways.items(), ("0.5", *COLOURS), strict=True):
        errors = Compared.of(folder, capture).score.errors_px
        label = "ends extrapolated" if name == "constant" else f"{name}, ends located"
        panel.semilogy(errors, color=colour, linewidth=1, label=label)
        numbers["ends_px"][name] = rounded(float(np.mean([errors[:length], errors[-length:]])))
        numbers["between_px"][name] = rounded(float(errors[length:-length].mean()))
    draw.name_axes(panel, "frame", "corner error (px)")
    figure.legend(loc="outside upper center", fontsize=8, ncols=4)
    return draw.in_bgr(figure), numbers


def ends_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of S2."""
    at_ends, between = numbers["ends_px"], numbers["between_px"]
    return [
        Claim(
            "errors accumulate at the ends if the end points are not estimated",
            f"ends extrapolated, three levels: {at_ends['constant']:g} px at the ends, {between['constant']:g} px between them",
            at_ends["constant"] > between["constant"],
        ),
        Claim(
            "estimating boundary frames mitigates this",
            f"ends located, three levels: {at_ends['level 3']:g} px at the ends, {between['level 3']:g} px between them",
            at_ends["level 3"] < at_ends["constant"],
        ),
    ]
