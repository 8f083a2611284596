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
AT_ONCE = 8  # items of a task, where there are many: as `photonpano.execution.Remote` has it


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
        """Predict a longer capture from this one and a shorter one: tasks and time of the client grow along a line."""
        grown = (n_frames - self.n_frames) / (self.n_frames - shorter.n_frames)
        kinds = {}
        for key, kind in self.kinds.items():
            before = shorter.kinds.get(key, Kind())
            # What is shared once a stage grows with the capture, what is done by the task grows in number.
            tasks = kind.tasks if key[1].startswith("shared") else round(kind.tasks + grown * (kind.tasks - before.tasks))
            each = (
                kind.to_worker + grown * (kind.to_worker - before.to_worker)
                if key[1].startswith("shared")
                else kind.to_worker * tasks / kind.tasks
            )
            share = tasks / kind.tasks
            kinds[key] = Kind(tasks, kind.seconds * share, round(each), round(kind.from_worker * share))
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
        shared: bytes that travel from the client to each worker.
        returned: bytes that travel to the client.
        read: bytes of the capture.
        begun_s: what each worker takes before its first task.
    """

    bundles: int
    first: tuple[float, float]
    second: tuple[float, float]
    shared: int
    returned: int
    read: float
    begun_s: float
    chained: bool = False

    def limits(self, costs: Costs, workers: int) -> dict[str, float]:
        """Return the seconds that each resource alone would take."""
        handed = self.bundles * (self.first[1] + self.second[1])
        return {
            "work of the workers": self.bundles * (self.first[0] + self.second[0]) / workers,
            "handing tasks on": handed * max(costs.client_s, costs.scheduler_s),
            "bytes to and from the client": (self.shared * workers + self.returned) / LINK_BYTES_S,
            "reading the capture": self.read / STORAGE_BYTES_S,
            "start of each worker": self.begun_s,
            "exposures that wait for the one before": self.bundles * self._link_s(costs) if self.chained else 0.0,
        }

    def _link_s(self, costs: Costs) -> float:
        """Return the seconds from the end of one second task to that of the next, where they are chained."""
        return self.second[0] + costs.client_s + costs.scheduler_s

    def seconds(self, costs: Costs, workers: int) -> float:
        """Simulate the stage: each task goes in order to the first worker that is free, with four under way for each worker."""
        handing_s = max(costs.client_s, costs.scheduler_s, self.returned / self.bundles / LINK_BYTES_S)
        read_s = self.read / self.bundles / (STORAGE_BYTES_S / workers)
        begin = self.begun_s + self.shared * workers / LINK_BYTES_S
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
    found, shared = list[Stage](), 0
    for stage, kinds in by_stage.items():
        shared += sum(kind.to_worker for name, kind in kinds.items() if name.startswith("shared"))
        tasks = {name: kind for name, kind in kinds.items() if not name.startswith(("shared", "kept"))}
        if not tasks:
            continue
        returned = sum(kind.from_worker for kind in tasks.values())
        read = run.n_frames * FRAME_BYTES
        if "describe" in tasks:
            first = stage.startswith("level 1")
            bundles = -(-tasks["describe"].tasks // AT_ONCE)
            moved_s = kinds["kept: features"].to_worker / bundles / LINK_BYTES_S
            registered = sum(kind.seconds for name, kind in tasks.items() if name.startswith("register"))
            describe, register = (tasks["describe"].seconds / bundles, 2.0), (registered / bundles + moved_s, 1.0)
            begun_s = 0.0 if first else costs.start_s * run.n_frames
            found.append(Stage(bundles, describe, register, shared, returned, read, begun_s, chained=first))
        else:
            bundles = -(-max(kind.tasks for kind in tasks.values()) // AT_ONCE)
            work = sum(kind.seconds for kind in tasks.values()) / bundles
            found.append(Stage(bundles, (work, 1.0), (0.0, 0.0), shared, returned, read if stage in READING else 0.0, 0.0))
        shared = 0
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
