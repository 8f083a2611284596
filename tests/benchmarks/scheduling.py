"""Predict what a run takes with many workers, from the tasks of a shorter run: a simulation of the scheduler."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from heapq import heappop, heappush

from speed import SHAPE

FRAME_BYTES = SHAPE[0] * SHAPE[1] // 8
STORAGE_BYTES_S = 5e9  # what a shared storage reads for all workers together: an assumption
LINK_BYTES_S = 1.25e9  # what the client, and each worker, sends and receives: an assumption, ten gigabits per second
WINDOW = 4  # tasks under way for each worker
READING = "panorama", "residuals"  # stages beside the levels that read the whole capture


@dataclass
class Kind:
    """Tasks of one kind in one stage: sums over the run."""

    tasks: int = 0
    seconds: float = 0.0
    to_worker: int = 0
    from_worker: int = 0


@dataclass(frozen=True)
class Measured:
    """One run.

    Attributes:
        n_frames: of the capture.
        kinds: tasks by stage and name.
        client_s: processor time beside the tasks.
    """

    n_frames: int
    kinds: dict[tuple[str, str], Kind]
    client_s: float

    def scaled(self, shorter: Measured, n_frames: int) -> Measured:
        """Predict a longer capture from this one and a shorter one: tasks, their bytes, and the client grow along a line."""
        grown = (n_frames - self.n_frames) / (self.n_frames - shorter.n_frames)
        kinds = {}
        for key, kind in self.kinds.items():
            before = shorter.kinds.get(key, kind)
            tasks = round(kind.tasks + grown * (kind.tasks - before.tasks))
            size, size_before = kind.to_worker / kind.tasks, before.to_worker / before.tasks
            sent, share = tasks * max(size, size + grown * (size - size_before)), tasks / kind.tasks
            kinds[key] = Kind(tasks, kind.seconds * share, round(sent), round(kind.from_worker * share))
        return Measured(n_frames, kinds, self.client_s + grown * (self.client_s - shorter.client_s))


@dataclass(frozen=True)
class Costs:
    """Processor seconds beside the work of tasks.

    Attributes:
        client_s: of a task, in the process of the run.
        scheduler_s: of a task, in the scheduler.
        start_s: of a frame, when a worker begins a level along a motion: it divides the capture into chunks.
    """

    client_s: float
    scheduler_s: float
    start_s: float


@dataclass(frozen=True)
class Stage:
    """Bundles of work that are worked on in order, as far as there are workers.

    Attributes:
        bundles: their number.
        first: seconds of the first task of a bundle, and how many tasks of the scheduler it is.
        second: the same of the task that follows it, and needs the first task of the bundle before, too.
        chained: whether the second task also needs that of the bundle before, as at the first level.
        moved: bytes that travel from and to the client.
        read: bytes of the capture.
        begun_s: what each worker takes before its first task.
    """

    bundles: int
    first: tuple[float, float]
    second: tuple[float, float]
    moved: int
    read: float
    begun_s: float
    chained: bool = False

    def limits(self, costs: Costs, workers: int) -> dict[str, float]:
        """Return the seconds that each resource alone would take."""
        handed = self.bundles * (self.first[1] + self.second[1])
        return {
            "work of the workers": self.bundles * (self.first[0] + self.second[0]) / workers,
            "handing tasks on": handed * max(costs.client_s, costs.scheduler_s),
            "bytes to and from the client": self.moved / LINK_BYTES_S,
            "reading the capture": self.read / STORAGE_BYTES_S,
            "start of each worker": self.begun_s,
            "exposures that wait for the one before": self.bundles * self._link_s(costs) if self.chained else 0.0,
        }

    def _link_s(self, costs: Costs) -> float:
        """Return the seconds from the end of one second task to that of the next, where they are chained."""
        return self.second[0] + costs.client_s + costs.scheduler_s

    def seconds(self, costs: Costs, workers: int) -> float:
        """Simulate the stage: each task goes in order to the first worker that is free, with four under way for each worker."""
        handing_s = max(costs.client_s, costs.scheduler_s, self.moved / self.bundles / LINK_BYTES_S)
        read_s = self.read / self.bundles / (STORAGE_BYTES_S / workers)
        begin = self.begun_s
        free, handed, described, end = [begin] * workers, begin, begin, begin
        done: list[float] = [begin]
        for index in range(self.bundles):
            if index >= WINDOW * workers:
                handed = max(handed, done[index - WINDOW * workers])
            handed += handing_s * self.first[1]
            before, described = described, max(heappop(free), handed) + self.first[0] + read_s
            heappush(free, described)
            if self.second[0]:
                handed += handing_s * self.second[1]
                waits = end + self._link_s(costs) - self.second[0] if self.chained else before
                end = max(heappop(free), handed, before, described, waits) + self.second[0]
                heappush(free, end)
            else:
                end = described
            done.append(max(done[-1], end))
        return done[-1]


def stages_of(run: Measured, costs: Costs) -> list[Stage]:
    """Return the stages of a run, as bundles of its tasks."""
    by_stage: dict[str, dict[str, Kind]] = defaultdict(dict)
    for (stage, name), kind in run.kinds.items():
        by_stage[stage][name] = kind
    found = list[Stage]()
    for stage, tasks in by_stage.items():
        bundles = max(kind.tasks for kind in tasks.values())
        moved, read = sum(kind.to_worker + kind.from_worker for kind in tasks.values()), run.n_frames * FRAME_BYTES
        if "describe" in tasks:
            chained = stage.startswith("level 1")
            first, second = tasks.pop("describe").seconds, sum(kind.seconds for kind in tasks.values())
            begun_s = 0.0 if chained else costs.start_s * run.n_frames
            found.append(Stage(bundles, (first / bundles, 1.0), (second / bundles, 1.0), moved, read, begun_s, chained))
        else:
            work = sum(kind.seconds for kind in tasks.values()) / bundles
            found.append(Stage(bundles, (work, 1.0), (0.0, 0.0), moved, read if stage in READING else 0.0, 0.0))
    return found


def prediction(run: Measured, costs: Costs, workers: int) -> tuple[float, dict[str, float]]:
    """Return the seconds of a run with so many workers, and what each resource alone would take."""
    stages = stages_of(run, costs)
    limits: dict[str, float] = defaultdict(float)
    for stage in stages:
        for name, seconds in stage.limits(costs, workers).items():
            limits[name] += seconds
    limits["work of the client"] = run.client_s
    return run.client_s + sum(stage.seconds(costs, workers) for stage in stages), dict(limits)
