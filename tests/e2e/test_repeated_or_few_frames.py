"""Captures whose frames occur twice, or are too few: what a run says of them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import check_run, parse_spec, run
from photonpano.execution.context import Quiet
from photonpano.pipeline.run import RunResult
from photonpano.record.run_json import verdict_of

pytestmark = pytest.mark.usefixtures("without_report")


@pytest.fixture
def run_of(tiny_spec: dict[str, Any], tiny_capture: Path, tmp_path: Path) -> Callable[..., RunResult]:
    """Run what becomes of the packed frames of a pan of 40 px."""

    def run_of(change: Callable[[np.ndarray], np.ndarray], group_size: int = 40) -> RunResult:
        np.save(tmp_path / "changed.npy", change(np.load(tiny_capture)))
        source = {"use": "packed-npy", "with": {"path": str(tmp_path / "changed.npy")}}
        changes = {"source": source, "resample": {"with": {"group_size": group_size}}}
        return run(parse_spec({**tiny_spec, **changes, "output": {"directory": str(tmp_path / "run")}}), Quiet())

    return run_of


def test_capture_in_which_each_frame_occurs_twice_is_trusted_with_a_warning(run_of: Callable[..., RunResult]) -> None:
    result = run_of(lambda frames: np.repeat(frames, 2, axis=0), 80)
    assert result.verdict.status == "trusted"
    assert result.record["warnings"][0].startswith("160 of 320 frames are copies of the frame before")
    assert check_run(result.directory, Quiet()).verdict.status == "trusted"


def test_run_of_20_frames_is_doubtful_and_lists_what_was_not_tested(run_of: Callable[..., RunResult]) -> None:
    result = run_of(lambda frames: frames[:20], 5)
    assert result.verdict.reasons[0].what.startswith("no test of the motion can be made")
    assert result.verdict.untested[0].endswith("(20 spans are too few: 50 are needed)")
    assert verdict_of(result.record["verdict"]) == result.verdict
