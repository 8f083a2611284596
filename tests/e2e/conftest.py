"""Run specs, and read results back from run folders."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

from photonpano import Plan, run
from photonpano.record.schema import RunRecord


@dataclass(frozen=True, eq=False)
class Outcome:
    """The files of a run folder."""

    directory: Path
    record: RunRecord
    trajectory: Mapping[str, np.ndarray] = field(init=False)

    def __post_init__(self) -> None:
        with np.load(self.directory / "trajectory.npz") as archive:
            object.__setattr__(self, "trajectory", dict(archive))

    @property
    def homographies(self) -> np.ndarray:
        return self.trajectory["homographies"]

    @property
    def located(self) -> np.ndarray:
        return self.trajectory["located"]

    @property
    def canvas(self) -> np.ndarray:
        return self.trajectory["canvas"]

    @property
    def flux(self) -> np.ndarray:
        return tifffile.imread(self.directory / "panorama.tiff")

    @property
    def coverage(self) -> np.ndarray:
        return tifffile.imread(self.directory / "coverage.tiff")


@pytest.fixture(scope="session")
def outcome_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Plan], Outcome]:
    """Run a plan into a new folder, without the report, which takes longer than the rest of a small run."""

    def outcome_of(plan: Plan) -> Outcome:
        output = plan.output.model_copy(update={"directory": tmp_path_factory.mktemp("run")})
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("photonpano.pipeline.run.render_report", lambda *_: "")
            result = run(replace(plan, output=output))
        return Outcome(result.directory, result.record)

    return outcome_of
