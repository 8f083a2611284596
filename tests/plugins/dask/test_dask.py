"""Runs on the workers of dask have the same results as runs on threads."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from photonpano import ExecutorContext, InputError, SpecError, parse_spec, run, simulate
from photonpano.execution.context import Quiet

pytest.importorskip("distributed")

import psutil

from photonpano_dask import workers
from photonpano_dask.configs import DaskConfig

FILES = "trajectory.npz", "panorama.tiff"


def worker_pids() -> list[int]:
    """Return the processes of the workers; children of other tests may end meanwhile."""
    found = []
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            if "spawn_main" in str(child.cmdline()):
                found.append(child.pid)
    return found


class Killing(Quiet):
    """Kills a worker in the middle of each of some stages, after Ctrl-C for all workers, which they ignore."""

    def __init__(self, *stages: str) -> None:
        self.stages, self.killed = list(stages), list[str]()

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        del total, unit

        def advance(_: int) -> None:
            if title in self.stages:
                self.stages.remove(title)
                for each in worker_pids():
                    os.kill(each, signal.SIGINT)
                os.kill(worker_pids()[0], signal.SIGKILL)
                self.killed.append(title)

        yield advance


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The spec of a capture in a file, of 200 frames."""
    capture = {
        "use": "simulator",
        "with": {
            "scene": {"kind": "street", "width": 400, "height": 300},
            "path": {"kind": "pan", "length_px": 30},
            "flux": 1,
            "n_frames": 200,
            "frame_shape": [64, 96],
        },
    }
    folder = tmp_path_factory.mktemp("capture")

    simulate(parse_spec({"version": 1, "source": capture}), folder / "cube.npy")
    source = {"use": "packed-npy", "with": {"path": str(folder / "cube.npy")}}
    return {"version": 1, "source": source, "resample": {"with": {"group_size": 50}}, "levels": 2, "refine": []}


@pytest.mark.filterwarnings("default")
@pytest.mark.usefixtures("without_report")
def test_same_bytes_and_decisions_as_on_threads_though_workers_are_killed(spec: dict[str, Any], tmp_path: Path) -> None:
    here = run(parse_spec(spec, output=tmp_path / "threads"))
    elsewhere = {"run": {"executor": {"use": "dask", "with": {"workers": 2}}}}
    killing = Killing("level 2: merge and locate", "panorama")
    there = run(parse_spec(spec | elsewhere, output=tmp_path / "dask"), killing)
    assert len(killing.killed) == 2
    for name in FILES:
        assert (tmp_path / "dask" / name).read_bytes() == (tmp_path / "threads" / name).read_bytes()
    assert there.record["decisions"] == here.record["decisions"]
    # Once for each of the two levels, which are merged along different motions.
    assert [each["what"] for each in here.record["decisions"]].count("chunk_frames") == 2
    assert not worker_pids()


class Lost:
    """A task whose worker was lost just after its result was gathered, so that it is no longer finished."""

    status = "pending"

    def __init__(self, result: Any) -> None:
        self._answer = result

    async def _result(self, raiseit: bool = True) -> Any:
        if raiseit and isinstance(self._answer, BaseException):
            raise self._answer
        return self._answer

    def cancel(self) -> None:
        self.status = "cancelled"


def test_result_counts_though_its_worker_is_lost_meanwhile() -> None:
    client = SimpleNamespace(loop=SimpleNamespace(add_callback=lambda call: asyncio.run(call())))
    executor = workers.DaskExecutor(client, 1, ExitStack())
    assert executor._wrap_future(Lost(3)).result(timeout=0) == 3
    assert isinstance(executor._wrap_future(Lost(ValueError("no"))).exception(timeout=0), ValueError)
    assert executor._wrap_future(Lost(CancelledError())).cancelled()


def test_scheduler_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "_PATIENCE_S", 0.5)
    with pytest.raises(InputError, match=r"no dask scheduler answers at tcp://127.0.0.1:9 .*start one with `dask scheduler`"):
        workers.executor_of(DaskConfig(address="tcp://127.0.0.1:9"), ExecutorContext(2))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"address": "host"}, "expected an address such as tcp://host:8786, got 'host'"),
        ({"address": "tcp://a:1", "workers": 2}, "the scheduler at the address has its own; remove one"),
        ({"workers": 0}, "expected an integer from 1 to 1024 or null, got 0"),
    ],
)
def test_wrong_keys_are_named(keys: dict[str, Any], message: str, spec: dict[str, Any]) -> None:
    with pytest.raises(SpecError) as caught:
        parse_spec(spec | {"run": {"executor": {"use": "dask", "with": keys}}})
    assert message in str(caught.value)
