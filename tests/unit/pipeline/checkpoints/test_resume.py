"""Whole runs that are interrupted, and go on with the same bytes."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import Plan, run
from photonpano.corrections import Vignette
from photonpano.pipeline.checkpoints.work_folder import Store, path_of
from photonpano.pipeline.run import RunResult
from photonpano.specs import parse_spec
from photonpano.values import FrameSpan
from photonpano_direct.locator import DirectLocator

SHAPE = (64, 96)
FILES = ("trajectory.npz", "panorama.tiff", "coverage.tiff")


class Killed(BaseException):
    pass


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write every result at once, so that a run can be killed after each."""
    monkeypatch.setattr("photonpano.pipeline.checkpoints.work_folder.FLUSH_S", 0.0)


@pytest.fixture(scope="module")
def capture(simulated: Callable[..., Path]) -> Path:
    return simulated(n_frames=240, frame_shape=list(SHAPE), path={"kind": "pan", "length_px": 40})


@pytest.fixture
def plan_of(capture: Path, tmp_path: Path) -> Callable[..., Plan]:
    spec: dict[str, Any] = {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(capture), "frame_rate_hz": 96800}},
        "resample": {"use": "midpoint", "with": {"group_size": 40}},
        "levels": 2,
    }

    def plan_of(name: str, **changes: Any) -> Plan:
        return parse_spec(spec | changes, output=tmp_path / name)

    return plan_of


def bytes_of(result: RunResult) -> list[bytes]:
    return [(result.directory / name).read_bytes() for name in FILES]


def decisions_of(result: RunResult) -> list[str]:
    return sorted(json.dumps(decision) for decision in result.record["decisions"])


def kill(monkeypatch: pytest.MonkeyPatch, plan: Plan, n_records: int) -> None:
    """Run a plan until it has kept this many more records, and kill it then."""
    save, saved = Store.save, 0

    def dying(self: Store, name: str, value: Any) -> bool:
        nonlocal saved
        saved += 1
        if saved > n_records:
            raise Killed
        return save(self, name, value)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "save", dying)
        with pytest.raises(Killed):
            run(plan, resume=True)


def test_run_killed_three_times_ends_with_the_same_bytes(plan_of: Callable[..., Plan], monkeypatch: pytest.MonkeyPatch) -> None:
    gain = np.linspace(0.9, 1, SHAPE[0] * SHAPE[1], dtype=np.float32).reshape(SHAPE)
    vignette = Vignette(gain, np.full_like(gain, 0.3), (FrameSpan(0, 240),))
    monkeypatch.setattr("photonpano.pipeline.passes.vignette_of", lambda *_: vignette)
    unbroken, killed = run(plan_of("unbroken")), plan_of("killed")
    for n_records in (4, 11, 6):
        kill(monkeypatch, killed, n_records)
    resumed = run(killed, resume=True)
    assert bytes_of(resumed) == bytes_of(unbroken)
    assert decisions_of(resumed) == decisions_of(unbroken)
    assert resumed.verdict == unbroken.verdict
    assert not path_of(resumed.directory).exists()


def test_resumed_run_repeats_nothing_that_was_kept(plan_of: Callable[..., Plan], monkeypatch: pytest.MonkeyPatch) -> None:
    killed = plan_of("killed", render={"scale": 1.5})

    def dies(*_: Any) -> None:
        raise Killed

    def repeats(*_: Any) -> None:
        pytest.fail("this was found before")

    with monkeypatch.context() as patch:
        patch.setattr("photonpano.pipeline.run_folder.RunFolder.write_results", dies)
        with pytest.raises(Killed):
            run(killed)
    monkeypatch.setattr(DirectLocator, "register", repeats)
    for step in ("motion.loop.starting_motion", "residuals.refinement.measure", "merging.panorama.accumulate"):
        monkeypatch.setattr(f"photonpano.{step}", repeats)
    run(killed, resume=True)
