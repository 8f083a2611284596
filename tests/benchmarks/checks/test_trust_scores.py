"""The scores of tests/benchmarks/trust.py, which itself takes too long to run here."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from photonpano.evaluation import Truth
from photonpano.geometry import translation
from photonpano_simulator.config import SimulatorConfig

SCRIPT = Path(__file__).parents[1] / "trust.py"
SHAPE = (60, 90)
N = 240  # all of which align the planes


@pytest.fixture(scope="module")
def trust() -> ModuleType:
    spec = importlib.util.spec_from_file_location("trust_benchmark", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPT.parent))  # as Python does for a script
        spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def scores(trust: ModuleType) -> ModuleType:
    """What `trust.py` has imported: the scores of results."""
    return sys.modules[trust.status.__module__]


def result(**keys: Any) -> dict[str, Any]:
    """Return the result of an honest run of the undisturbed pan."""
    scores = {"mean_px": 0.1, "max_px": 0.3, "rms_px": 0.1, "std_px": 0.1, "within_2": 1.0, "within_3": 1.0}
    said = {"row": "clean pan", "seed": 0, "exit_code": 0, "message": "", "verdict": None, "warnings": [], "seconds": 5.0}
    return said | scores | keys


def test_figures_of_trajectory_with_known_errors(trust: ModuleType) -> None:
    true = np.array([translation(0.1 * frame, 5) for frame in range(N)])
    # Signs that alternate: no alignment of the planes removes such errors.
    errors = np.tile([0.1, -0.1, 0.5, -0.5, 0.1, -0.1, 0.5, -0.5], N // 8)
    estimated = {
        "homographies": np.array([each @ translation(error, 0) for each, error in zip(true, errors, strict=True)]),
        "std_px": np.tile([0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.1, 0.1], N // 8),
        "located": np.ones(N, bool),
        "frame_shape": np.array(SHAPE),
    }
    figures = trust.figures_of(estimated, Truth(true, SHAPE, None, true))
    assert figures["mean_px"] == pytest.approx(0.3, rel=0.01)
    assert figures["rms_px"] == pytest.approx(np.sqrt((0.1**2 + 0.5**2) / 2), rel=0.01)
    assert figures["max_px"] == pytest.approx(0.5, rel=0.02)
    assert figures["std_px"] == pytest.approx(0.175)
    # 0.1 px of 0.2 px; 0.5 px of 0.2 px, which is 2.5; and 0.5 px of 0.1 px, which is 5.
    assert (figures["within_2"], figures["within_3"]) == (0.5, 0.75)


def test_frames_that_are_not_located_are_not_scored(trust: ModuleType) -> None:
    true = np.array([translation(0.1 * frame, 5) for frame in range(N)])
    wrong = true.copy()
    wrong[180:] = np.eye(3)
    located = np.arange(N) < 180
    estimated = {"homographies": wrong, "std_px": np.full(N, 0.1), "located": located, "frame_shape": np.array(SHAPE)}
    figures = trust.figures_of(estimated, Truth(true, SHAPE, None, true))
    assert figures["max_px"] < 1e-6
    assert figures["located"] == 0.75


def test_trajectory_of_other_frames_has_no_figures(trust: ModuleType) -> None:
    still = np.tile(np.eye(3), (5, 1, 1))
    truth = Truth(still, SHAPE, None, still)
    for frames, shape in ((4, SHAPE), (5, (60, 720))):
        estimated = {"homographies": np.tile(np.eye(3), (frames, 1, 1)), "frame_shape": np.array(shape)}
        assert trust.figures_of(estimated, truth) == {}


@pytest.mark.parametrize(
    ("keys", "honest"),
    [
        ({}, True),
        ({"within_2": 0.94}, False),
        ({"within_3": 0.98}, False),
        ({"std_px": 0.31}, False),
        ({"within_3": 0.5, "verdict": {"status": "trusted", "reasons": []}}, False),
        ({"within_3": 0.5, "verdict": {"status": "doubtful", "reasons": []}}, True),
        ({"exit_code": None}, False),
    ],
)
def test_run_is_honest_if_its_claim_holds_or_is_doubted(scores: ModuleType, keys: dict[str, Any], honest: bool) -> None:
    assert scores.is_honest(result(**keys)) is honest


def test_refused_run_is_honest_and_trusted_one_without_score_is_not(scores: ModuleType) -> None:
    refused = {key: value for key, value in result(exit_code=1).items() if not key.endswith(("_px", "_2", "_3"))}
    assert scores.is_honest(refused)
    assert not scores.is_honest(refused | {"exit_code": 0})


def test_table_has_a_row_for_each_kind_of_capture(scores: ModuleType) -> None:
    doubted = {"status": "doubtful", "reasons": [{"what": "parts of the sensor are dark"}]}
    lines = scores.table(
        [
            result(),
            result(row="vignette 80%", mean_px=0.4, max_px=0.9, std_px=0.2, rms_px=0.4, verdict=doubted),
            result(row="vignette 80%", seed=1, within_2=0.5, within_3=0.6, below_oracle_db=0.25),
        ]
    ).splitlines()
    assert lines[2] == "| clean pan | 0.100 (0.30) | 0.100 | 100% / 100% | 1.00 | - | - | - | - | 1 of 1 | 5 s |"
    assert lines[3] == (
        "| vignette 80% | 0.250 (0.90) | 0.150 | 50% / 60% | 0.60 | 4.00 | 0.25 dB | 1 doubtful, 1 - | 1 of 1 | 1 of 2 | 5 s |"
    )
    assert lines[5:] == [
        "2 of 3 runs are honest; 1 of 1 that are doubtful or refused name the cause. 1 are doubtful, 0 of them wrong; "
        "100.0% / 100.0% of their frames are within 2 / 3 std_px, which is 0.50 times the rms error (median).",
        "",
        "- vignette 80%, seed 0: parts of the sensor are dark",
    ]


@pytest.mark.parametrize(
    ("row", "reason", "right"),
    [
        ("tremor of 1 px", "the image moves within groups", True),
        ("tremor of 1 px", "the light changes", False),
        ("lens k1 -1.0%", "frames are deformed as with a lens", True),
        ("clean pan", "the light changes", False),
    ],
)
def test_right_reason_has_a_word_of_the_cause(scores: ModuleType, row: str, reason: str, right: bool) -> None:
    doubt = result(row=row, verdict={"status": "doubtful", "reasons": [{"what": "something else"}, {"what": reason}]})
    assert scores.names_its_cause(doubt) is right
    assert scores.names_its_cause(result(row=row, exit_code=1, message=reason)) is right


def test_rows_that_are_disturbed_have_a_cause(scores: ModuleType) -> None:
    without = [name for name in scores.ROWS if not any(part in name for part in scores.CAUSES)]
    assert [name for name in without if not name.startswith("clean")] == []


def test_results_are_kept_for_captures_of_one_size(trust: ModuleType, tmp_path: Path) -> None:
    file = tmp_path / "trust.json"
    assert trust.remembered(file, trust.SMALL) == []
    trust.write(file, [result()], trust.SMALL)
    assert trust.remembered(file, trust.SMALL) == [result()]
    assert json.loads(file.read_text())["frame_shape"] == [128, 192]
    assert "| clean pan |" in file.with_suffix(".md").read_text()
    with pytest.raises(SystemExit, match="holds results of frames of"):
        trust.remembered(file, trust.FULL)


def test_rows_are_captures_that_the_simulator_makes(trust: ModuleType, scores: ModuleType) -> None:
    for size in (trust.FULL, trust.SMALL):
        for row in scores.ROWS.values():
            SimulatorConfig.model_validate(trust.bases(size)[row.base] | row.changes(size))
