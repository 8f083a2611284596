"""Measure the tasks of runs, and predict runs of many workers: the tables and the plot of docs/explanation/scale.md.

    python tests/benchmarks/scale.py docs/explanation/scale.md [--frames 10000 40000]

Runs captures of several lengths in one thread, with an executor that works on copies, as another process would. It notes the
processor time and the bytes of each task, and the processor time of the client beside them. A simulation of the scheduler then
works on the tasks of longer captures with many workers.
"""

from __future__ import annotations

import json
import pickle
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import ExitStack, contextmanager
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import psutil
from distributed import Client
from harness import IMAGES, command, packed, passing, table, write_tables
from scheduling import Costs, Kind, Measured, prediction
from speed import GROUP_SIZE, PX_A_FRAME, SHAPE, THREADS, simulated

from photonpano import Config, ExecutorContext, ExecutorContribution, FrameSpan, discover, parse_spec, run
from photonpano.execution.context import Quiet, _each
from photonpano.execution.threads import in_order
from photonpano.geometry import FrameTrajectory
from photonpano.merging import chunks_of
from photonpano.motion.registration import ExposureTasks, worked
from photonpano_dask.configs import DaskConfig

DASK = discover().find("executor", "dask").contribution
LONG = 60_000_000  # ten minutes at 100,000 frames per second
WORKERS = 1, 8, 64, 512
EMPTY_TASKS = 2000
PATH_FRAMES = 400_000


class NoKeys(Config):
    """No keys."""


class Measuring(Executor):
    """Works on each task at once on copies, as another process would, and notes what it takes and what travels."""

    under_way = 1

    def __init__(self, stage: Callable[[], str]) -> None:
        self.kinds: dict[tuple[str, str], Kind] = defaultdict(Kind)
        self.seconds = 0.0
        self._stage = stage

    def submit(self, work: Callable[..., Any], *given: Any) -> Future[Any]:
        """Work on a task, and note it."""
        begin, done = time.thread_time(), Future[Any]()
        result = work(*given)
        seconds = time.thread_time() - begin
        returned = pickle.dumps(result, pickle.HIGHEST_PROTOCOL)
        done.set_result(pickle.loads(returned))
        kind = self.kinds[self._stage(), name_of(*pickle.loads(given[0]))]
        kind.tasks += 1
        kind.seconds += seconds
        kind.to_worker += len(given[0])
        kind.from_worker += len(returned)
        self.seconds += time.thread_time() - begin
        return done


def name_of(work: Any, given: tuple[Any, ...]) -> str:
    """Return the name of a task: of the function whose items it works on."""
    while isinstance(work, partial) or work in (worked, _each):
        if isinstance(work, partial):
            work, given = work.func, (*work.args, *given)
        else:
            work, given = given[given[0].__class__ is ExposureTasks], ()
    return str(work.__name__).lstrip("_")


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
    stages = Stages()
    executor = Measuring(lambda: stages.title)
    offer = ExecutorContribution(name="measuring", summary="Notes tasks", config=NoKeys, build=lambda *_: executor)
    settings = {"threads": 1, "executor": "measuring"}
    spec = packed(cube, None, resample={"with": {"group_size": GROUP_SIZE}}, run=settings)
    begin = time.process_time()
    run(parse_spec(spec, output=cube.with_suffix(".run"), catalog=discover().including(offer)), stages)
    return Measured(n_frames, dict(executor.kinds), time.process_time() - begin - executor.seconds)


def measured_costs() -> Costs:
    """Have a cluster of this machine work on empty tasks, and divide a long path into chunks."""
    with cluster() as (address, scheduler):
        executor = DASK.build(DaskConfig(address=address), ExecutorContext(THREADS))
        list(in_order(len, [[each] for each in range(200)], executor.under_way, executor))
        before = time.process_time(), sum(scheduler.cpu_times()[:2])
        list(in_order(len, [[each] for each in range(EMPTY_TASKS)], executor.under_way, executor))
        client, handed = time.process_time() - before[0], sum(scheduler.cpu_times()[:2]) - before[1]
        executor.shutdown()
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
            sizes = (f"{size / kind.tasks / 1e3:,.1f} kB" for size in (kind.to_worker, kind.from_worker))
            yield stage, name, f"{kind.tasks:,}", f"{1e3 * kind.seconds / kind.tasks:.1f} ms", *sizes


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
        cubes = [simulated(study, number, "smooth") for number in frames]
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
