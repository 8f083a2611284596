"""What the figures share: captures and runs that are kept, results, and claims of the paper beside what was measured."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import cv2
import numpy as np
from picture_parts import GAP, picture
from ruamel.yaml import YAML

from photonpano import PhotonpanoError, evaluate, open_source, parse_spec, run
from photonpano.captures.writing import truth_path, write_packed
from photonpano.context import Context
from photonpano.evaluation import (
    corner_errors,
    covered,
    image_score,
    load_run_trajectory,
    load_truth,
    true_panorama,
    white_flux,
)
from photonpano.geometry import FrameTrajectory, apply
from photonpano.merging.panorama import plan_canvas, render

if TYPE_CHECKING:
    from picture_parts import Picture

    from photonpano import Panorama
    from photonpano.evaluation import RunTrajectory, TrajectoryScore, Truth

SPECS = Path(__file__).parents[3] / "examples" / "paper"
FAILED_DB = 3.0
"""A panorama that is further below the one along the true motion, in dB, has failed."""
Numbers: TypeAlias = dict[str, Any]
"""Figures by name: numbers, words, and lists and mappings of them, which do not depend on the machine."""
Changes: TypeAlias = Mapping[str, Any]
"""Keys of a spec, with dots, and their values."""


class Claim(NamedTuple):
    """A statement of the paper beside what was measured.

    Attributes:
        paper: what the paper says.
        measured: what was measured.
        agrees: whether they agree; None where there is nothing to agree with.
    """

    paper: str
    measured: str
    agrees: bool | None

    def row(self) -> str:
        """Return a row of a table in Markdown."""
        return f"| {self.paper} | {self.measured} | {({True: 'yes', False: '**no**', None: ''})[self.agrees]} |"


class FigureOf(NamedTuple):
    """A figure of the paper: how it is made, and what its numbers say.

    Attributes:
        make: measures, and draws.
        claims: what the paper says of it, beside the numbers.
    """

    make: Callable[[Study], tuple[Picture | None, Numbers]]
    claims: Callable[[Numbers], list[Claim]]


@dataclass(frozen=True)
class Study:
    """A folder of captures and runs, which are used again, and the size of both.

    Attributes:
        folder: for captures and runs.
        quick: whether captures are small: some hundreds of frames.
    """

    folder: Path
    quick: bool

    def spec(self, name: str, changes: Changes, quick: Changes) -> dict[str, Any]:
        """Return a spec of examples/paper with changes, and with those of the quick study if this is one."""
        spec: dict[str, Any] = YAML(typ="safe").load((SPECS / f"{name}.yaml").read_text(encoding="utf-8"))
        for key, value in {**changes, **(quick if self.quick else {})}.items():
            *parents, last = key.split(".")
            section = spec
            for parent in parents:
                section = section.setdefault(parent, {})
            section[last] = value
        return spec

    def capture(self, name: str, spec: Mapping[str, Any]) -> Path:
        """Return the capture that the source of a spec simulates, with its truth beside it."""
        path = self.folder / f"{name}-{digest(spec['source'])}.npy"
        if not truth_path(path).exists():
            with open_source(parse_spec({"version": 1, "source": spec["source"]})) as source:
                write_packed(source, path)
        return path

    def run(self, name: str, spec: Mapping[str, Any], capture: Path | None = None) -> Path:
        """Run a spec, on a capture that its source has simulated, and return the run folder."""
        spec = dict(spec)
        if capture is not None:
            rate = spec["source"]["with"].get("frame_rate_hz", 96_800)
            spec["source"] = {"use": "packed-npy", "with": {"path": str(capture.absolute()), "frame_rate_hz": rate}}
        folder = self.folder / f"{name}-{digest(spec)}"
        if not (folder / "run.json").exists():
            run(parse_spec(spec, output=folder))
        return folder


def frames_of(spec: Mapping[str, Any]) -> Numbers:
    """Return how many frames the capture of a spec has, and at which rate."""
    return {key: spec["source"]["with"][key] for key in ("n_frames", "frame_rate_hz")}


def chained(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return a spec that registers each exposure with the one before by SIFT, as in the paper, in light that is steady."""
    graph = {"skips": [], "closure_overlap": None}
    return {**spec, "locate": {"use": "opencv-sift"}, "graph": graph, "light": "steady"}


def digest(content: object) -> str:
    """Return eight characters that differ for other contents."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]


def scores_of(folder: Path, capture: Path) -> Numbers:
    """Return the errors of the path of a run, in px, and of its panorama, in dB below the one along the true path."""
    scores = evaluate(folder, truth_path(capture))
    assert scores.panorama is not None
    assert scores.below_oracle_db is not None
    return {
        "mean_px": rounded(scores.trajectory.mean_px),
        "worst_px": rounded(scores.trajectory.max_px),
        "psnr_db": round(scores.panorama.psnr_db, 1),
        "below_oracle_db": round(scores.below_oracle_db, 1),
    }


def fails(scores: Mapping[str, Any]) -> bool:
    """Return whether there is no motion, or one that spoils the panorama: by more than FAILED_DB."""
    return "reason" in scores or scores["below_oracle_db"] > FAILED_DB


def told(scores: Mapping[str, Any]) -> str:
    """Return the scores of a path and its panorama in words."""
    return scores.get("reason") or (
        f"mean corner error {scores['mean_px']:g} px, largest {scores['worst_px']:g} px, {scores['below_oracle_db']:.1f} dB "
        "below the panorama along the true motion"
    )


def scores_or_reason(run_folder: Callable[[], Path], capture: Path) -> tuple[Path | None, Numbers]:
    """Run, and return the run folder and the scores, or no folder and the reason why there is no motion."""
    try:
        folder = run_folder()
    except PhotonpanoError as error:
        return None, {"reason": str(error).splitlines()[0]}
    return folder, scores_of(folder, capture)


def motion_of(folder: Path, capture: Path) -> tuple[RunTrajectory, Truth, TrajectoryScore]:
    """Return the motion of a run, the truth, and the errors."""
    found, truth = load_run_trajectory(folder), load_truth(truth_path(capture))
    return found, truth, corner_errors(found.homographies, truth.homographies, found.frame_shape, found.located)


def record_of(folder: Path) -> dict[str, Any]:
    """Return the record of a run."""
    record: dict[str, Any] = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    return record


def rounded(value: float, digits: int = 3) -> float:
    """Round to a number of significant digits: more are noise."""
    return float(f"{value:.{digits}g}")


def widened(image: Picture, width: int) -> Picture:
    """Fill up with white, on the right."""
    missing = [(0, 0), (0, width - image.shape[1]), *[(0, 0)] * (image.ndim - 2)]
    return np.pad(image, missing, constant_values=255)


def in_rows(rows: list[Picture]) -> Picture:
    """Put pictures below each other, with gaps."""
    width = max(row.shape[1] for row in rows)
    gap = np.full((GAP, width, *rows[0].shape[2:]), 255, np.uint8)
    return np.vstack([part for row in rows for part in (widened(row, width), gap)][:-1])


def in_colour(image: Picture) -> Picture:
    """Return a grey picture with three equal channels."""
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


def averaged_in_place(folder: Path, capture: Path) -> tuple[Panorama, float]:
    """Return a baseline: the averages of the groups of a run of one level, each placed as a whole where it was located.

    Returns:
        The panorama, and its PSNR in dB.
    """
    found, truth = load_run_trajectory(folder), load_truth(truth_path(capture))
    with np.load(folder / "exposures" / "level-1.npz") as level:
        homographies, instants = level["homographies"], level["instants"]
    nearest = np.abs(np.arange(len(found.homographies))[:, None] - instants).argmin(axis=1)
    placed = FrameTrajectory(homographies[nearest])
    with open_source(parse_spec(record_of(folder)["spec"])) as source:
        span, shape = source.info.span, source.info.frame_shape
        canvas = plan_canvas(placed, span, shape, 1.0, 2**31)
        panorama = render(source, placed, span, canvas, 0.25, Context(2))
    alignment = corner_errors(homographies, truth.homographies[instants.round().astype(int)], shape).alignment
    assert truth.scene is not None
    scene = true_panorama(truth.scene, canvas, alignment)
    compared = covered(panorama.weight) & np.isfinite(scene) & np.isfinite(panorama.flux)
    return panorama, image_score(panorama.flux, scene, compared, white_flux(truth.scene)).psnr_db


def place(panorama: Panorama, point: tuple[float, float], radius: tuple[int, int], white: float) -> Picture:
    """Return the surroundings of a point of the reference plane, magnified twice."""
    x, y = apply(panorama.canvas, np.array([point]))[0].round().astype(int)
    x = int(np.clip(x, radius[0], panorama.flux.shape[1] - radius[0]))
    y = int(np.clip(y, radius[1], panorama.flux.shape[0] - radius[1]))
    part = panorama.flux[y - radius[1] : y + radius[1], x - radius[0] : x + radius[0]]
    return np.repeat(np.repeat(picture(part, white), 2, 0), 2, 1)


def fitted(image: Picture, width: int) -> Picture:
    """Scale a picture to a width."""
    return cv2.resize(image, (width, round(image.shape[0] * width / image.shape[1])), interpolation=cv2.INTER_AREA).astype(
        np.uint8
    )
