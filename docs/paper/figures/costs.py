"""Group sizes over speed and light, and the number of exposures against sliding windows."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import picture_parts as draw
from harness import Compared, Study
from paper.figures.study import QUICK_STREET, Claim, Numbers, frames_of, levels_of, rounded

from photonpano import PhotonpanoError
from photonpano_core.configs import MidpointConfig
from photonpano_core.resamplers import MidpointResampler

SIZES = (125, 250, 500, 750, 1500)
LENGTHS_PX = (120, 480)
FLUXES = (0.2, 0.01)
USUAL = 250, 750  # group sizes that the paper recommends
GOOD_PX = 0.5  # largest mean error of a result of high quality
QUICK = {**QUICK_STREET, "source.with.frame_shape": [96, 144], "source.with.n_frames": 3000}
QUICK_SIZES, QUICK_LENGTHS_PX, QUICK_FLUXES = (60, 250), (40, 100), (0.3,)
QUICK_TIME = {**QUICK, "source.with.path.length_px": 100, "source.with.flux": 0.3, "resample.with.group_size": 200}
QUICK_WINDOWS = {**QUICK_TIME, "resample.with.step_frames": 50}
LENGTHS = (10_000, 30_000, 100_000)  # frames of the captures whose exposures are counted
SPEED = Path(__file__).parents[2] / "explanation" / "speed.md"
LAST = 3  # level whose exposures are as dense as sliding windows with a step of a quarter of a group


def group_sizes(study: Study) -> tuple[draw.Picture, Numbers]:
    """Measure the error of each group size over speed and light."""
    sizes, lengths, fluxes = (QUICK_SIZES, QUICK_LENGTHS_PX, QUICK_FLUXES) if study.quick else (SIZES, LENGTHS_PX, FLUXES)
    errors: dict[str, list[float | None]] = {}
    figure, axes = draw.panels(9.68, 3.4, 1, len(lengths), sharey=True)
    for panel, length in zip(axes, lengths, strict=True):
        for flux in fluxes:
            spec = study.spec("paper/group-size", {"source.with.flux": flux}, QUICK)
            spec["source"]["with"]["path"] = spec["source"]["with"]["path"] | {"length_px": length}
            capture = study.capture("group-size", spec)
            found: list[float | None] = []
            for size in sizes:
                spec["resample"] = {"use": "midpoint", "with": {"group_size": size}}
                try:
                    run = study.run("group-size", spec, capture)
                    found.append(rounded(Compared.of(run, capture).score.mean_px))
                except PhotonpanoError:
                    found.append(None)
            speed = f"{length / spec['source']['with']['n_frames']:.2g} px a frame"
            errors[f"{speed}, {flux:g} photons"] = found
            panel.loglog(sizes, [np.nan if each is None else each for each in found], ".-", label=f"{flux:g} photons a frame")
        panel.axvspan(*USUAL, color="0.9")
        panel.set_title(speed, fontsize=10)
        draw.ticks(panel, {size: str(size) for size in sizes})
        draw.name_axes(panel, "group size (frames)")
    axes[0].set_ylabel("mean corner error (px)", fontsize=9)
    axes[0].legend(fontsize=8)
    return draw.in_bgr(figure), frames_of(spec) | {"sizes": list(sizes), "error_px": errors}


def sizes_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of the group size."""
    found = {
        name: {size: error for size, error in zip(numbers["sizes"], errors, strict=True) if error is not None}
        for name, errors in numbers["error_px"].items()
    }
    rows = []
    for name, errors in found.items():
        shown = ", ".join(f"{size}: {f'{errors[size]:g} px' if size in errors else 'failed'}" for size in numbers["sizes"])
        good = any(error <= GOOD_PX for error in usual(errors).values())
        rows.append(Claim(f"a group of {USUAL[0]} to {USUAL[1]} frames achieves high quality: {name}", shown, good))
    largest = {
        name: max((size for size, error in errors.items() if error <= GOOD_PX), default=0) for name, errors in found.items()
    }
    names = list(largest)
    slow_dark, fast_bright = names[len(names) // 2 - 1], names[len(names) // 2]
    ratio = max(max(errors.values()) / min(errors.values()) for errors in map(usual, found.values()) if errors)
    return [
        *rows,
        Claim(
            "higher values suit low light, lower ones fast motion: up to which size it works",
            "; ".join(f"{name}: {size}" for name, size in largest.items()),
            largest[slow_dark] > largest[names[0]] and largest[fast_bright] < largest[names[0]],
        ),
        Claim(
            "the same: which of the sizes that work is best",
            f"not decided by one capture each: errors between {USUAL[0]} and {USUAL[1]} frames differ by a factor of at most "
            f"{ratio:.1f}",
        ),
    ]


def usual(errors: dict[int, float]) -> dict[int, float]:
    """Return the errors of the group sizes that the paper recommends."""
    return {size: error for size, error in errors.items() if USUAL[0] <= size <= USUAL[1]}


def run_time(study: Study) -> tuple[None, Numbers]:
    """Count the exposures and the frames that they take, and measure the error against that of sliding windows."""
    quick = {"group-size": QUICK_TIME, "sliding-window": QUICK_WINDOWS}
    specs = {name: study.spec(f"paper/{name}", {}, changes) for name, changes in quick.items()}
    capture = study.capture("group-size", specs["group-size"])
    numbers: Numbers = frames_of(specs["group-size"])
    for name, spec in specs.items():
        folder = study.run(name, spec, capture)
        numbers[name] = {
            "exposures": sum(levels_of(folder, "groups")),
            "pairs": sum(levels_of(folder, "pairs")),
            "error_px": rounded(Compared.of(folder, capture).score.mean_px),
        }
    counted = {size: [exposures(n_frames, size) for n_frames in LENGTHS] for size in (250, 500, 1000)}
    numbers["exposures"] = {str(size): found for size, found in counted.items()}
    numbers["power_of_n"] = round(float(np.polyfit(np.log(LENGTHS), np.log(counted[500]), 1)[0]), 2)
    at = {size: found[-1] for size, found in counted.items()}
    numbers["power_of_m"] = round(float(np.polyfit(np.log(list(at)), np.log(list(at.values())), 1)[0]), 2)
    # The only number that depends on the machine is taken from the page of such numbers.
    measured = re.search(rf"^\| {LENGTHS[-1]:,} \| smooth \| ([\d.]+) s \|", SPEED.read_text(encoding="utf-8"), re.MULTILINE)
    assert measured is not None
    numbers["seconds"] = round(float(measured[1]))
    return None, numbers


def exposures(n_frames: int, group_size: int) -> int:
    """Return how many exposures all levels have."""
    resampler = MidpointResampler(MidpointConfig(group_size=group_size))
    return sum(len(resampler.groups(n_frames, level)) for level in range(1, LAST + 1))


def run_time_claims(numbers: Numbers) -> list[Claim]:
    """Return what the paper says of the run time."""
    ours, windows = numbers["group-size"], numbers["sliding-window"]
    at = {size: found[-1] for size, found in numbers["exposures"].items()}
    windows_over_ours = LENGTHS[-1] * LAST / at["500"]
    return [
        Claim(
            "the run time is O(n/m): registration, and so the number of exposures, bounds it",
            f"exposures of {LAST} levels of {LENGTHS[-1]:,} frames: "
            + ", ".join(f"{found:,} with m = {size}" for size, found in at.items())
            + f"; they grow with n to the power of {numbers['power_of_n']:g}, and with m to that of {numbers['power_of_m']:g}",
            abs(numbers["power_of_n"] - 1) < 0.1 and abs(numbers["power_of_m"] + 1) < 0.1,
        ),
        Claim(
            "a sliding window around each instant extracts features from hundreds of thousands of exposures",
            f"{LENGTHS[-1] * LAST:,} exposures in {LAST} levels of {LENGTHS[-1]:,} frames, {windows_over_ours:.0f} times "
            f"as many as with m = 500",
            LENGTHS[-1] * LAST > 100_000,
        ),
        Claim(
            "significant speedup over sliding windows, which are less exact at first",
            f"against windows a quarter of a group apart, as dense as our last level: {ours['pairs']:,} pairs instead of "
            f"{windows['pairs']:,}, and a mean error of {ours['error_px']:g} px instead of {windows['error_px']:g} px",
            ours["pairs"] < windows["pairs"],
        ),
        Claim(
            "ten minutes an iteration for 100,000 frames",
            f"[{numbers['seconds']} s for the whole run](../explanation/speed.md#whole-runs), with all defaults, on two cores",
            numbers["seconds"] < 600,
        ),
    ]
