"""The schema of `run.json`. Keys may be added; those that are here keep their meaning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NotRequired, TypedDict


class SourceRecord(TypedDict):
    """The capture."""

    n_frames: int
    height: int
    width: int
    frame_rate_hz: float | None
    kind: str


class PluginRecord(TypedDict):
    """Who provided a stage: the component's name, its distribution and version."""

    stage: str
    use: str
    plugin: str
    version: str


class PairRecord(TypedDict):
    """A pair of exposures, as half-open frame spans [start, stop)."""

    moving: Sequence[int]
    fixed: Sequence[int]


class RescuedRecord(PairRecord):
    """A pair that the first locator lost, and the fallback that located it."""

    by: str


class FailureRecord(PairRecord):
    """A pair that was not located: the reason, and the numbers behind it (None where one is not finite)."""

    reason: str
    evidence: Mapping[str, float | None]


class ClosureRecord(TypedDict):
    """Loop closures: pairs of exposures that may show one place at different times, and how many of them were located."""

    pairs: int
    located: int


class CameraRecord(TypedDict):
    """A camera that turns: focal length and principal point in px of a frame, and k1, k2, p1, p2 of its lens.

    `std_focal_px` and `std_distortion` are the expected errors of what was found, 0 for what was given, None if not known.
    """

    focal_px: float
    std_focal_px: float | None
    centre_px: Sequence[float]
    distortion: Sequence[float]
    std_distortion: Sequence[float]


class RivalRecord(TypedDict):
    """How well a model of the motion explains the pairs of a level.

    `chi2` is the mean square of their residuals, in units of photon noise; `deviance` is minus twice the logarithm of its
    marginal likelihood, above that of the likeliest model; `apart_px` is the mean distance of the corners by it from those by
    the model that was taken.
    """

    chi2: float
    unknowns: int
    deviance: float
    apart_px: float


class LevelRecord(TypedDict):
    """One level.

    `groups` and `located` count virtual exposures, `pairs` and `failures` pairs of them; `located_by` counts located pairs by
    locator. `revisits` are loop closures. `contradictions` are located pairs that were dropped as outliers. `change_px` is the
    mean distance by which the level moved the corners of the frames, None at the first level; `std_px` is the expected corner
    error, None where a single exposure was located. `camera` is that of a level whose camera turns, None where homographies
    were fitted; `walks_px` is how far zoom, shears and perspectives of these move the ends of a frame over the capture, and
    `evidence` how well models explain the pairs of the last level. `seconds` has an entry for each stage.
    """

    level: int
    scale: float
    groups: int
    group_frames: int
    pairs: int
    located: int
    located_by: Mapping[str, int]
    rescued: Sequence[RescuedRecord]
    failures: Sequence[FailureRecord]
    revisits: ClosureRecord
    contradictions: Sequence[PairRecord]
    change_px: float | None
    std_px: float | None
    residual_px: float
    camera: CameraRecord | None
    evidence: Mapping[str, RivalRecord]
    walks_px: Mapping[str, float]
    seconds: Mapping[str, float]


class MotionRecord(TypedDict):
    """The expected corner error of the located frames, in px: its mean, the largest, and the frame that has it."""

    std_px: float
    worst_std_px: float
    worst_frame: int


class DecisionRecord(TypedDict):
    """A value that the spec left open: what was chosen, and why."""

    what: str
    value: bool | int | float | str
    reason: str


class PanoramaRecord(TypedDict):
    """The panorama: `coverage_share` is the share of pixels that were seen, `white_flux` the flux that is white in the PNG.

    `picture_reduction` is the factor by which the PNG is smaller than the panorama, 1 unless that was rendered in tiles.
    `dynamic_range_db` is the ratio of the highest and the lowest flux that noise alone does not reach, and
    `measurable_range_db` what the mean number of frames over a pixel can measure, or the former if that is more, both None
    where nothing exceeds its noise; `saturated_share` is the share of the seen pixels that were lit in every frame. `decisions`
    are the names of those that renderer and exporters took.
    """

    height: int
    width: int
    scale: float
    picture_reduction: int
    white_flux: float
    coverage_share: float
    seconds: float
    dynamic_range_db: NotRequired[float | None]
    measurable_range_db: NotRequired[float | None]
    saturated_share: NotRequired[float]
    decisions: Sequence[str]


class RefinementRecord(TypedDict):
    """What a refiner did: the summary of each correction, and the mean displacement of the corners.

    `kept_out` is why its last motion was not used, None if it was.
    """

    use: str
    rounds: Sequence[str]
    change_px: float
    kept_out: str | None


class AgreementRecord(TypedDict):
    """How frames agree, see `Agreements`: those before `frame` and from it on, or a stretch from it on and all others.

    None where they share nothing.
    """

    frame: int
    coherence: float | None
    std_coherence: float | None
    std_px: Sequence[float]
    angle_deg: float | None


class DetailRecord(TypedDict):
    """The finest real detail, see `Detail`: as a period in px of a frame, None if there is none.

    `grid_px` is the shortest period that the grid holds. Of each of `frequencies`, in cycles per px, `halves` is the
    correlation of the first and the last half of the frames, and `scene` that of all frames with the scene, which follows from
    it. `parts` are thirds of the panorama, from that which few frames saw. `noise` is the root mean square difference of the
    halves in units of what photon noise explains, None where they share nothing.
    """

    finest_px: float | None
    grid_px: float
    frequencies: Sequence[float]
    halves: Sequence[float]
    scene: Sequence[float]
    parts: Sequence[Mapping[str, float | None]]
    noise: float | None


class ReasonRecord(TypedDict):
    """Why a run is doubtful: the number that decided, the largest that is trusted, where, and what to do."""

    what: str
    figure: float
    threshold: float
    where: str
    what_to_do: str


class VerdictRecord(TypedDict):
    """Whether motion and panorama, or what was found instead, explain the photons.

    `status` is "trusted" or "doubtful". `residual_ratio` is the scatter of the shifts of short spans of frames, in units of
    what noise explains: about 1 if nothing is left. None if there are too few frames to tell. Another kind of run
    has residuals of its own there. `reduced_chi2` is how well the panorama explains the photons of spans, without the share
    that they have in it themselves: 1 where only photon noise is left; None without a panorama. `untested` lists the tests
    that could not be made, and why, in clauses that begin with "whether"; `notes` is what was found, too, that is too small to
    make motion or panorama wrong.
    """

    status: str
    reasons: Sequence[ReasonRecord]
    residual_ratio: float | None
    untested: NotRequired[Sequence[str]]
    notes: NotRequired[Sequence[ReasonRecord]]
    reduced_chi2: NotRequired[float | None]


class FileContent(TypedDict):
    """The size of a file, and its SHA-256 in hexadecimal digits."""

    bytes: int
    sha256: str


class FileRecord(TypedDict):
    """A file, or a folder of files, that the source, a correction or the motion graph reads.

    `bytes` is the size of all its files, `modified` the latest of their times, ISO 8601 in UTC; None where there is none.
    `etag` is the mark that a server gives the content of a URL; None for other files.
    """

    path: str
    bytes: int | None
    modified: str | None
    etag: str | None


class CaptureRecord(TypedDict):
    """The fingerprint of a capture.

    `frames_sha256` is of sampled frames, as the source and the corrections of the spec give them. `pixels_sha256` is of the
    mask and of what corrections make of a sum of frames.
    """

    files: Sequence[FileRecord]
    frames_sha256: str
    pixels_sha256: str


class RunRecord(TypedDict):
    """The content of `run.json`.

    `created` is an ISO 8601 time. `motion` and `panorama` are None where a run has none, as one of another kind, which has
    what it found under the name of its kind instead. `findings` are those of a panorama, by the names of the fields of
    `Findings`.
    `detail` is None where the capture is too short for halves.
    `peak_memory_bytes` is None where the system does not report it.
    `capture` is the fingerprint of what was read; `files` lists the other files of the run folder.
    `rendered_from` is the run folder whose motion was rendered again, None where the motion was estimated.
    """

    photonpano: str
    status: str
    created: str
    spec: Mapping[str, Any]
    spec_file: str | None
    seed: int
    source: SourceRecord
    plugins: Sequence[PluginRecord]
    libraries: Mapping[str, str]
    decisions: Sequence[DecisionRecord]
    findings: NotRequired[Mapping[str, Any]]
    levels: Sequence[LevelRecord]
    motion: MotionRecord | None
    refinements: Sequence[RefinementRecord]
    halves: Sequence[AgreementRecord]
    stretches: Sequence[AgreementRecord]
    detail: NotRequired[DetailRecord | None]
    verdict: VerdictRecord | None
    panorama: PanoramaRecord | None
    warnings: Sequence[str]
    seconds: float
    peak_memory_bytes: int | None
    capture: CaptureRecord
    files: NotRequired[Mapping[str, FileContent]]
    rendered_from: str | None
