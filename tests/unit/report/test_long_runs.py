"""What is done with every frame at the end of a run takes memory for its motion and little more, and pages do not grow."""

import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import Refined
from photonpano.contracts.requirements import require_refined
from photonpano.geometry import FrameTrajectory, nearest_rotations, steps_px
from photonpano.merging import chunks_of
from photonpano.merging.panorama import RenderedPanorama, plan_canvas
from photonpano.motion.frame_motion import FrameMotion
from photonpano.pipeline.run_folder import run_folder
from photonpano.residuals.halves import Halves
from photonpano.residuals.measure import Residuals
from photonpano.residuals.refinement import Explained, bounded_std_px, residual_ratio, unexplained_px
from photonpano_core.configs import ShortSpansConfig
from photonpano_core.refiners import ShortSpansRefiner

SHORT, LONG = 20_000, 80_000


@dataclass(frozen=True)
class End:
    """The end of a run of a capture that trembles."""

    motion: FrameMotion
    panorama: RenderedPanorama
    residuals: Residuals
    record: dict[str, Any]

    @property
    def n_frames(self) -> int:
        return len(self.motion.homographies)

    @property
    def explained(self) -> Explained:
        return Explained(
            motion=self.motion,
            canvas=self.panorama.canvas,
            residuals=self.residuals,
            ratio=1.0,
            halves=Halves.none(),
            refinements=(),
        )

    def refined(self) -> Refined | None:
        refiner = ShortSpansRefiner(ShortSpansConfig(), self.motion.frame_shape, 96_800.0)
        motion = self.motion
        return refiner.refine(None, motion.trajectory, motion.std_px, self.residuals.steps(), None)

    def written(self, directory: Path) -> None:
        with run_folder(directory) as folder:
            folder.write_results(self.panorama, self.motion)
            record = folder.commit(self.record)
            folder.add_report("<html></html>")
            folder.update(record)


@pytest.fixture(scope="module")
def ends(
    results_of: Callable[[int], tuple[FrameMotion, RenderedPanorama]],
    tremor_of: Callable[[int], Residuals],
    record_of: Callable[[int, RenderedPanorama], dict[str, Any]],
) -> tuple[End, End]:
    """Return the end of a short run, and that of a run four times as long."""

    def end(n_frames: int) -> End:
        motion, panorama = results_of(n_frames)
        motion = replace(motion, trajectory=FrameTrajectory(motion.homographies))
        return End(motion, panorama, tremor_of(n_frames), record_of(n_frames, panorama))

    return end(SHORT), end(LONG)


def bytes_a_frame(work: Callable[[End], object], ends: tuple[End, End]) -> float:
    """Return by how many bytes the memory that some work takes grows for each frame."""
    peaks = []
    for end in ends:
        tracemalloc.start()
        try:
            work(end)
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    return (peaks[1] - peaks[0]) / (LONG - SHORT)


@pytest.mark.parametrize(
    ("work", "most"),
    [
        pytest.param(lambda end: end.motion.trajectory.at(np.arange(end.n_frames)), 100, id="motion"),
        pytest.param(lambda end: steps_px(end.motion.homographies, end.motion.frame_shape), 40, id="steps"),
        pytest.param(lambda end: nearest_rotations(end.motion.homographies), 80, id="rotations"),
        pytest.param(lambda end: chunks_of(end.motion.span, end.motion.trajectory, (254, 496), 0.5), 60, id="chunks"),
        pytest.param(lambda end: plan_canvas(end.motion.trajectory, end.motion.span, (254, 496), 1.0, 2**31), 150, id="canvas"),
        pytest.param(lambda end: residual_ratio(end.residuals), 40, id="ratio"),
        pytest.param(lambda end: unexplained_px(end.residuals, end.n_frames), 60, id="unexplained"),
        pytest.param(lambda end: bounded_std_px(end.motion.std_px, end.residuals), 80, id="bounds"),
        pytest.param(End.refined, 150, id="refinement"),
        pytest.param(
            lambda end: require_refined(Refined(end.motion.homographies, end.motion.std_px, ""), None, None, end.motion.std_px),
            40,
            id="check",
        ),
    ],
)
def test_memory_for_a_frame_is_little_more_than_its_motion(
    work: Callable[[End], object], most: float, ends: tuple[End, End]
) -> None:
    """A homography takes 72 bytes."""
    assert bytes_a_frame(work, ends) < most
