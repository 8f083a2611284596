"""Measure the tasks of runs, and predict runs of many workers: the tables and the plot of docs/explanation/scale.md.

    python tests/benchmarks/scale.py docs/explanation/scale.md [--frames 10000 40000]

Runs captures of several lengths in one thread, with an executor that packs what each task is given and returns, as for another
process. It notes the processor time and the bytes of each task, and the processor time of the client beside them. A simulation
of the scheduler then works on the tasks of longer captures with many workers.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any
from unittest import mock

import matplotlib.pyplot as plt
import numpy as np
import psutil
from distributed import Client
from harness import IMAGES, command, packed, passing, table, write_tables
from scheduling import Costs, Kind, Measured, prediction
from speed import GROUP_SIZE, PX_A_FRAME, SHAPE, THREADS, simulated

from photonpano import ExecutorContext, FrameSpan, Source, discover, parse_spec, run
from photonpano.capture import capture_of
from photonpano.execution import CaptureElsewhere, LocalExecutor
from photonpano.execution.context import Quiet
from photonpano.execution.executor import packed as packed_for_worker
from photonpano.geometry import FrameTrajectory
from photonpano.merging import chunks_of
from photonpano_dask.configs import DaskConfig

DASK = discover().find("executor", "dask").contribution
LONG = 60_000_000  # ten minutes at 100,000 frames per second
WORKERS = 1, 8, 64, 512
EMPTY_TASKS = 2000
PATH_FRAMES = 400_000


class Measuring(LocalExecutor):
    """Works on each task here, and notes what it takes and what would travel."""

    def __init__(self, capture: Source, stage: Callable[[], str]) -> None:
        super().__init__(1)
        self.kinds: dict[tuple[str, str], Kind] = defaultdict(Kind)
        self.packing_seconds = 0.0
        self._capture, self._stage = capture, stage
        self._stay: dict[int, Any] = {}

    def share(self, value: Any) -> Any:
        """Note a value that travels to each worker once."""
        kind = self.kinds[self._stage(), f"shared: {name_of(value)}"]
        kind.tasks += 1
        kind.to_worker += self._size(value)
        self._stay[id(value)] = value
        return value

    def call(self, work: Callable[..., Any], *given: Any) -> Any:
        """Note a task."""
        return self._measured(work, given, lambda result: result)

    def keep(self, work: Callable[..., Any], *given: Any) -> Any:
        """Note a task whose first result stays, and that result by itself: it travels at most to the worker of a pair."""
        kept, known = self._measured(work, given, lambda both: both[1])
        self._stay[id(kept)] = kept
        kind = self.kinds[self._stage(), "kept: features"]
        kind.tasks += 1
        kind.to_worker += self._size(kept)
        return kept, known

    def _measured(self, work: Callable[..., Any], given: tuple[Any, ...], returned: Callable[[Any], Any]) -> Any:
        kind = self.kinds[self._stage(), name_of(work)]
        kind.tasks += 1
        kind.to_worker += sum(self._size(each) for each in (work, *given) if id(each) not in self._stay)
        begin = time.thread_time()
        result = work(*given)
        kind.seconds += time.thread_time() - begin
        kind.from_worker += self._size(returned(result))
        return result

    def _size(self, value: Any) -> int:
        begin = time.thread_time()
        size = len(packed_for_worker(value, self._capture))
        self.packing_seconds += time.thread_time() - begin
        return size


def name_of(work: Any) -> str:
    """Return the name of a task."""
    work = work.func if isinstance(work, partial) else work
    return str(getattr(work, "__name__", type(work).__name__)).lstrip("_")


class Stages(Quiet):
    """Knows which stage is under way."""

    title = "before"

    @contextmanager
    def stage(self, title: str, total: int, unit: str) -> Iterator[Callable[[int], None]]:
        del total, unit
        self.title = title
        yield lambda _: None
        self.title = f"after {title}"


def measured(cube: Path, n_frames: int) -> Measured:
    """Run a capture with the executor that measures."""
    stages, executors = Stages(), list[Measuring]()

    @contextmanager
    def executor_of(_: Any, source: Source) -> Iterator[Measuring]:
        executors.append(Measuring(capture_of(source).source, lambda: stages.title))
        yield executors[0]

    spec = packed(cube, None, resample={"with": {"group_size": GROUP_SIZE}}, run={"threads": 1})
    begin = time.process_time()
    with mock.patch("photonpano.pipeline.run.executor_of", executor_of):
        run(parse_spec(spec, output=cube.with_suffix(".run")), stages)
    whole = time.process_time() - begin
    executor = executors[0]
    tasks = sum(kind.seconds for kind in executor.kinds.values())
    return Measured(n_frames, dict(executor.kinds), whole - tasks - executor.packing_seconds)


def measured_costs() -> Costs:
    """Have a cluster of this machine work on empty tasks, and divide a long path into chunks."""
    with cluster() as (address, scheduler):
        context = ExecutorContext(THREADS, CaptureElsewhere(None, dict), here={}, elsewhere=dict)
        executor = DASK.build(DaskConfig(address=address), context)
        with ThreadPoolExecutor(executor.under_way) as pool:
            list(pool.map(partial(executor.call, len), [[each] for each in range(200)]))
            before = time.process_time(), sum(scheduler.cpu_times()[:2])
            list(pool.map(partial(executor.call, len), [[each] for each in range(EMPTY_TASKS)]))
            client, handed = time.process_time() - before[0], sum(scheduler.cpu_times()[:2]) - before[1]
        executor.close()
    path = np.tile(np.eye(3), (PATH_FRAMES, 1, 1))
    path[:, 0, 2] = PX_A_FRAME * np.arange(PATH_FRAMES)
    trajectory, begin = FrameTrajectory(path), time.process_time()
    chunks_of(FrameSpan(0, PATH_FRAMES), trajectory, SHAPE, 0.5)
    return Costs(client / EMPTY_TASKS, handed / EMPTY_TASKS, (time.process_time() - begin) / PATH_FRAMES)


@contextmanager
def cluster() -> Iterator[tuple[str, psutil.Process]]:
    """Start a scheduler and two workers in processes of their own."""
    with passing() as study, ExitStack() as stack:
        file = study.folder / "scheduler.json"

        def started(*words: str) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(
                [sys.executable, "-m", "dask", *words, "--scheduler-file", str(file)], stderr=subprocess.DEVNULL
            )
            stack.callback(process.wait)
            stack.callback(process.terminate)
            return process

        scheduler = started("scheduler", "--port", "0", "--dashboard-address", ":0")
        while not file.exists():
            time.sleep(0.1)
        started("worker", "--nworkers", "2", "--nthreads", "1", "--no-dashboard")
        address = json.loads(file.read_text())["address"]
        with Client(address) as client:
            client.wait_for_workers(2)
        yield address, psutil.Process(scheduler.pid)


def rows_of_tasks(run: Measured) -> Iterator[Sequence[str]]:
    """Yield the rows of the table of tasks."""
    for (stage, name), kind in run.kinds.items():
        if not stage.startswith("after") and kind.tasks:
            time_ms = "" if name.startswith(("shared", "kept")) else f"{1e3 * kind.seconds / kind.tasks:.1f} ms"
            sizes = (f"{size / kind.tasks / 1e3:,.1f} kB" if size else "" for size in (kind.to_worker, kind.from_worker))
            yield stage, name, f"{kind.tasks:,}", time_ms, *sizes


def rows_of_predictions(run: Measured, costs: Costs, limits: dict[int, dict[str, float]]) -> Iterator[Sequence[str]]:
    """Yield the rows of the table of predictions, and note the limits for the plot."""
    alone = 0.0
    for workers in WORKERS:
        seconds, limits[workers] = prediction(run, costs, workers)
        alone = alone or seconds
        name, most = max(limits[workers].items(), key=itemgetter(1))
        yield f"{workers}", clock(seconds), f"{alone / seconds:.1f}", name, clock(most)
        limits[workers]["all"] = seconds


def clock(seconds: float) -> str:
    """Return a duration for people."""
    return f"{seconds / 3600:.1f} h" if seconds >= 3600 else f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"


def plot(limits: dict[int, dict[str, float]], file: Path) -> None:
    """Draw what each resource takes, for each number of workers."""
    figure, axes = plt.subplots(figsize=(7, 3.6), layout="constrained")
    for name in limits[WORKERS[0]]:
        seconds = [limits[workers][name] for workers in WORKERS]
        style = {"color": "black", "linewidth": 2.5} if name == "all" else {"marker": "o", "markersize": 3}
        axes.loglog(WORKERS, np.maximum(seconds, 1), label="the run" if name == "all" else name, **style)
    axes.set_xticks(WORKERS, [str(each) for each in WORKERS])
    axes.set_xlabel("workers")
    axes.set_ylabel("seconds, ten minutes of capture")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    figure.savefig(file, dpi=110)


def main(page: Path | None, frames: Sequence[int] = (10_000, 40_000)) -> None:
    """Measure two captures, the shorter first, predict, and write the page."""
    costs, limits = measured_costs(), dict[int, dict[str, float]]()
    with passing() as study:
        cubes = [simulated(study, number) for number in frames]
        # What is imported and loaded once does not count.
        measured(cubes[0], frames[0])
        shorter, longer = (measured(cube, number) for cube, number in zip(cubes, frames, strict=True))
    client_s = (longer.client_s - shorter.client_s) / (longer.n_frames - shorter.n_frames)
    told = (
        f"A task costs {costs.client_s * 1e3:.1f} ms of processor time in the client, and {costs.scheduler_s * 1e3:.1f} ms in "
        f"the scheduler. Beside the tasks, the client takes {1e6 * client_s:.0f} s for a million frames. A worker divides a "
        f"million frames into chunks in {1e6 * costs.start_s:.1f} s."
    )
    print(told)
    tasks = table(("Stage", "Task", "Tasks", "Time of one", "To the worker", "Back"), rows_of_tasks(longer))
    rows = rows_of_predictions(longer.scaled(shorter, LONG), costs, limits)
    predictions = table(("Workers", "Predicted", "Speed-up", "What limits", "Its share"), rows)
    write_tables(page, {"tasks": tasks, "costs": [told], "predictions": predictions})
    if page:
        plot(limits, IMAGES / "scale.png")


if __name__ == "__main__":
    command(main, "tasks", "costs", "predictions")
