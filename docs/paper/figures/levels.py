"""Figs. 3, 5, 6 and S2: what the levels do for a camera that trembles, with and without new groups."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from paper.figures.study import (
    Claim,
    FigureOf,
    averaged_in_place,
    fitted,
    frames_of,
    in_rows,
    motion_of,
    place,
    record_of,
    rounded,
    scores_of,
)
from picture_parts import beside, drawn, labelled, picture

from photonpano import load_panorama
from photonpano.geometry import apply

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from numpy.typing import NDArray
    from paper.figures.study import Numbers, Study
    from picture_parts import Picture

    from photonpano import Panorama

QUICK = {
    "source.with.path": {"kind": "random-spline", "length_px": 60, "shake": {"rms_px": 1.5, "frequencies_hz": [450, 800]}},
    "source.with.scene": {"kind": "street", "width": 512, "height": 341, "seed": 3},
    "source.with.n_frames": 1200,
    "source.with.frame_shape": [96, 128],
    "source.with.flux": 0.5,
    "resample.with.group_size": 100,
}
LEVELS = 3
"""Levels of Fig. 3, Fig. 5 and S2."""
COLOURS = ("#c8a26b", "#1f5a94", "#7a1f5a")
"""Of the levels."""
ENDS = 0.5
"""Length of an end of the capture, in groups."""


def runs(study: Study) -> tuple[dict[str, Any], Path, list[Path]]:
    """Return the spec, the capture, and the runs of one level, of two, and of three."""
    spec = study.spec("fig6", {}, QUICK)
    capture = study.capture("fig6", spec)
    return spec, capture, [study.run("fig6", spec | {"levels": [{"scale": 1}] * n}, capture) for n in range(1, LEVELS + 1)]


def constant(study: Study, capture: Path) -> Path:
    """Return the run with a constant number of groups, which locates no end by itself."""
    return study.run("fig5", study.spec("fig5", {}, QUICK), capture)


def settings(spec: dict[str, Any]) -> Numbers:
    """Return how large the capture and its groups are."""
    return {
        **frames_of(spec),
        "flux": spec["source"]["with"]["flux"],
        "group_size": spec["resample"]["with"]["group_size"],
    }


def loop(study: Study) -> tuple[Picture, Numbers]:
    """Fig. 3: the estimated path, with expected errors, after each level."""
    spec, capture, folders = runs(study)
    rate = spec["source"]["with"]["frame_rate_hz"] / 1000
    figure = Figure(figsize=(10, 5.6), dpi=100, layout="constrained")
    panels = figure.subplots(2, LEVELS, sharex=True)
    levels: Numbers = {"error_px": [], "expected_px": [], "exposures": []}
    for column, (folder, colour) in enumerate(zip(folders, COLOURS, strict=True)):
        found, truth, score = motion_of(folder, capture)
        with np.load(folder / "exposures" / f"level-{column + 1}.npz") as level:
            spans, instants = level["frames"], level["instants"].round().astype(int)
        middle = (np.array(found.frame_shape[::-1]) - 1) / 2
        true = apply(truth.homographies, middle[None])[:, 0]
        estimated = apply(score.alignment @ found.homographies, middle[None])[:, 0]
        for start, stop in spans[:: 2 ** (column + 1)]:
            panels[0, column].axvspan(start / rate, stop / rate, color=colour, alpha=0.2, linewidth=0)
        milliseconds = np.arange(len(true)) / rate
        panels[0, column].plot(milliseconds, true[:, 0], color="0.6", linewidth=3, label="true path")
        panels[0, column].plot(milliseconds, estimated[:, 0], color=colour, linewidth=1, label="estimated")
        panels[0, column].set_title(f"level {column + 1}: {len(spans)} exposures", fontsize=10)
        error = estimated - true
        panels[1, column].plot(milliseconds, error[:, 0], color=colour, linewidth=0.8)
        bars = {"fmt": ".", "color": "black", "markersize": 4, "linewidth": 0.8}
        panels[1, column].errorbar(instants / rate, error[instants, 0], found.std_px[instants], **bars)
        panels[1, column].set_xlabel("ms", fontsize=9)
        levels["error_px"].append(rounded(score.mean_px))
        levels["expected_px"].append(rounded(float(found.std_px[found.located].mean())))
        levels["exposures"].append(len(spans))
    panels[0, 0].legend(fontsize=8)
    panels[0, 0].set_ylabel("x (px)", fontsize=9)
    panels[1, 0].set_ylabel("error of x, with expected errors (px)", fontsize=9)
    return drawn(figure)[..., 2::-1], settings(spec) | levels


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


def without_new_groups(study: Study) -> tuple[Picture, Numbers]:
    """Fig. 5: the panorama with a constant number of groups, and with new groups at each level."""
    spec, capture, folders = runs(study)
    ways = {"constant number of groups": constant(study, capture), "new groups at each level": folders[-1]}
    worst = int(np.argmax(np.where(inside(spec), motion_of(ways["constant number of groups"], capture)[2].errors_px, 0)))
    figure = Figure(figsize=(9.68, 2.6), dpi=100, layout="constrained")
    panel = figure.subplots()
    shown, numbers = [], settings(spec)
    for (name, folder), colour in zip(ways.items(), COLOURS, strict=False):
        found, _, score = motion_of(folder, capture)
        panorama = load_panorama(folder)
        middle = (np.array(found.frame_shape[::-1]) - 1) / 2
        point = apply(found.homographies[worst], middle[None])[0]
        radius = min(120, panorama.flux.shape[1] // 2), min(90, panorama.flux.shape[0] // 2)
        shown.append(labelled(place(panorama, (point[0], point[1]), radius, float(np.nanquantile(panorama.flux, 0.995))), name))
        panel.plot(score.errors_px, color=colour, linewidth=1, label=name)
        numbers[name.split()[0]] = scores_of(folder, capture) | {"exposures": record_of(folder)["levels"][-1]["groups"]}
    panel.set_xlabel("frame", fontsize=9)
    panel.set_ylabel("corner error (px)", fontsize=9)
    panel.legend(fontsize=8)
    return in_rows([beside(shown), drawn(figure)[..., 0]]), numbers


def inside(spec: dict[str, Any]) -> NDArray[np.bool_]:
    """Return the frames that are more than a group from both ends: (T,)."""
    n_frames, group = spec["source"]["with"]["n_frames"], spec["resample"]["with"]["group_size"]
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
            f"panorama {few['below_oracle_db']:.1f} dB below the one along the true motion, with new groups "
            f"{many['below_oracle_db']:.1f} dB",
            few["below_oracle_db"] > many["below_oracle_db"] + 1,
        ),
    ]


def refinement(study: Study) -> tuple[Picture, Numbers]:
    """Fig. 6: averages of groups, and panoramas of one level and of two."""
    spec, capture, folders = runs(study)
    naive, naive_db = averaged_in_place(folders[0], capture)
    panoramas: dict[str, Panorama] = {
        f"averages of {spec['resample']['with']['group_size']:,} frames": naive,
        "one level": load_panorama(folders[0]),
        "two levels": load_panorama(folders[1]),
    }
    found = motion_of(folders[1], capture)[0]
    middle = (np.array(found.frame_shape[::-1]) - 1) / 2
    white = float(np.nanquantile(panoramas["two levels"].flux, 0.995))
    rows = []
    for name, panorama in panoramas.items():
        places = [apply(found.homographies[frame], middle[None])[0] for frame in (0, len(found.homographies) // 2)]
        radius = min(60, panorama.flux.shape[1] // 2), min(60, panorama.flux.shape[0] // 2)
        insets = [place(panorama, (x, y), radius, white) for x, y in places]
        whole = picture(panorama.flux, white)
        scale = insets[0].shape[0] / whole.shape[0]
        rows.append(labelled(beside([fitted(whole, round(whole.shape[1] * scale)), *insets]), name))
    numbers = settings(spec) | {"averages_psnr_db": round(naive_db, 1)}
    return in_rows(rows), numbers | {"levels": [scores_of(folder, capture) for folder in folders]}


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
            f"below the panorama along the true motion: {second['below_oracle_db']:.1f} dB after two levels, "
            f"{third['below_oracle_db']:.1f} dB after three",
            third["below_oracle_db"] < 1,
        ),
    ]


def ends(study: Study) -> tuple[Picture, Numbers]:
    """S2: errors at the ends of the capture, where they are located and where they are extrapolated."""
    spec, capture, folders = runs(study)
    group = spec["resample"]["with"]["group_size"]
    length = int(ENDS * group)
    figure = Figure(figsize=(9.68, 3), dpi=100, layout="constrained")
    panel = figure.subplots()
    numbers = settings(spec) | {"ends_px": {}, "between_px": {}}
    ways = {"constant": constant(study, capture), **{f"level {n + 1}": folder for n, folder in enumerate(folders)}}
    for (name, folder), colour in zip(ways.items(), ("0.5", *COLOURS), strict=True):
        errors = motion_of(folder, capture)[2].errors_px
        panel.semilogy(
            errors, color=colour, linewidth=1, label="ends extrapolated" if name == "constant" else f"{name}, ends located"
        )
        numbers["ends_px"][name] = rounded(float(np.mean([errors[:length], errors[-length:]])))
        numbers["between_px"][name] = rounded(float(errors[length:-length].mean()))
    panel.set_xlabel("frame", fontsize=9)
    panel.set_ylabel("corner error (px)", fontsize=9)
    figure.legend(loc="outside upper center", fontsize=8, ncols=4)
    return drawn(figure)[..., 2::-1], numbers


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


FIG3 = FigureOf(loop, loop_claims)
FIG5 = FigureOf(without_new_groups, groups_claims)
FIG6 = FigureOf(refinement, refinement_claims)
S2 = FigureOf(ends, ends_claims)
