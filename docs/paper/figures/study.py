"""What the figures share: claims of the paper beside what was measured, and scores that do not depend on the machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from harness import Compared, Study, record_of, rendered
from harness import scores_of as evaluation_of
from picture_parts import Picture

from photonpano import Panorama, PhotonpanoError
from photonpano.evaluation import corner_errors, covered
from photonpano.geometry import Canvas, FrameTrajectory

FAILED_DB = 3.0  # a panorama that is further below the one along the true motion has failed
QUICK_STREET = {
    "source.with.scene": {"kind": "street", "width": 1024, "height": 682},
    "source.with.frame_shape": [128, 192],
}
"""What makes most captures of a quick study small."""
Numbers: TypeAlias = dict[str, Any]
"""Figures by name: numbers, words, and lists and mappings of them, which do not depend on the machine."""


class Claim(NamedTuple):
    """A statement of the paper beside what was measured.

    Attributes:
        paper: what the paper says.
        measured: what was measured.
        agrees: whether they agree; None where there is nothing to agree with.
    """

    paper: str
    measured: str
    agrees: bool | None = None

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


def frames_of(spec: Mapping[str, Any], *keys: str) -> Numbers:
    """Return how many frames the capture of a spec has, at which rate, and other settings of its source."""
    return {key: spec["source"]["with"][key] for key in ("n_frames", "frame_rate_hz", *keys)}


def group_size(spec: Mapping[str, Any]) -> int:
    """Return how many frames are merged into an exposure."""
    return int(spec["resample"]["with"]["group_size"])


def chained(spec: Mapping[str, Any]) -> dict[str, Any]:
    """Return a spec that registers each exposure with the one before by SIFT, as in the paper, in light that is steady."""
    graph = {"skips": [], "closure_overlap": None}
    return {**spec, "locate": {"use": "opencv-sift"}, "graph": graph, "light": "steady"}


def scores_of(folder: Path, capture: Path) -> Numbers:
    """Return the errors of the path of a run, in px, and of its panorama, in dB below the one along the true path."""
    scores = evaluation_of(folder, capture)
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
        f"mean corner error {scores['mean_px']:g} px, largest {scores['worst_px']:g} px, {scores['below_oracle_db']:z.1f} dB "
        "below the panorama along the true motion"
    )


def reason_of(error: PhotonpanoError) -> str:
    """Return the first line of an error."""
    return str(error).splitlines()[0]


def scores_or_reason(run_folder: Callable[[], Path], capture: Path) -> tuple[Path | None, Numbers]:
    """Run, and return the run folder and the scores, or no folder and the reason why there is no motion."""
    try:
        folder = run_folder()
    except PhotonpanoError as error:
        return None, {"reason": reason_of(error)}
    return folder, scores_of(folder, capture)


def levels_of(folder: Path, key: str) -> list[int]:
    """Return a number of each level of a run, such as that of its groups."""
    return [level[key] for level in record_of(folder)["levels"]]


def rounded(value: float, digits: int = 3) -> float:
    """Round to a number of significant digits: more are noise."""
    return float(f"{value:.{digits}g}")


def first_exposures(run: Compared) -> tuple[Any, Any, Any]:
    """Return the homographies and instants of the exposures of level 1, and how they are aligned with the true plane."""
    with np.load(run.folder / "exposures" / "level-1.npz") as level:
        homographies, instants = level["homographies"], level["instants"]
    true = run.truth.homographies[instants.round().astype(int)]
    return homographies, instants, corner_errors(homographies, true, run.found.frame_shape).alignment


def averaged_in_place(folder: Path, capture: Path) -> tuple[Panorama, float]:
    """Return a baseline: the averages of the groups of a run of one level, each placed as a whole where it was located.

    Returns:
        The panorama, and its PSNR in dB.
    """
    run = Compared.of(folder, capture)
    homographies, instants, alignment = first_exposures(run)
    nearest = np.abs(np.arange(len(run.found.homographies))[:, None] - instants).argmin(axis=1)
    with run.source() as source:
        panorama = rendered(source, FrameTrajectory(homographies[nearest]), tolerance_px=0.25)
    scene = run.scene(Canvas(*panorama.flux.shape[:2], panorama.canvas), alignment)
    compared = covered(panorama.weight) & np.isfinite(scene) & np.isfinite(panorama.flux)
    return panorama, run.psnr_db(panorama.flux, scene, compared)
