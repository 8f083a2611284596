"""Measure what share of a run its safety takes: hashes, checkpoints, locks, and the step of the run folder.

    python tests/benchmarks/safety_costs.py scan.yaml

The exit code is 1 if it is more than 3 %.
"""

from __future__ import annotations

import os
import pkgutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from crashes import preload, prepare, warm_up
from harness import command, passing

COSTS = {
    "fingerprint of the capture": ("photonpano.pipeline.run_steps.fingerprint",),
    "lock, run folder and work folder": (
        "photonpano.pipeline.run_steps.run_folder",
        "photonpano.pipeline.run_steps.work_folder",
    ),
    "checkpoints": (
        "photonpano.pipeline.checkpoints.store.Store.save",
        "photonpano.pipeline.checkpoints.store.Store.load",
        "photonpano.pipeline.checkpoints.kept.Kept._name",
    ),
    "hashes of results": ("photonpano.pipeline.run_folder.contents_of",),
    "flushes, and the step": (
        "photonpano.pipeline.run_folder.replace_folder",
        "photonpano.pipeline.run_folder.RunFolder.reopen",
    ),
}
"""Functions whose time is the cost of safety."""
_fsync = os.fsync


class Stopwatch:
    """Adds up the processor's time of functions, and their waits for the disk; of nested ones, the outermost counts.

    Other programs on the machine change neither much.
    """

    def __init__(self) -> None:
        self.seconds = Counter[str]()
        self._running = threading.local()

    @contextmanager
    def running(self, what: str) -> Iterator[None]:
        if getattr(self._running, "what", None):
            yield
            return
        self._running.what, start = what, time.thread_time()
        try:
            yield
        finally:
            self._running.what = None
            self.seconds[what] += time.thread_time() - start

    def flush(self, descriptor: int) -> None:
        """Wait for the disk."""
        start = time.perf_counter()
        _fsync(descriptor)
        self.seconds["waits for the disk"] += time.perf_counter() - start

    def timed(self, function: Callable[..., Any], what: str) -> Callable[..., Any]:
        """Return a function, or one that returns a context, whose time is added up; that of the block is not."""

        def call(*args: Any, **keys: Any) -> Any:
            with self.running(what):
                found = function(*args, **keys)
            return self._entered(found, what) if isinstance(found, AbstractContextManager) else found

        return call

    @contextmanager
    def _entered(self, context: AbstractContextManager[Any], what: str) -> Iterator[Any]:
        with ExitStack() as stack:
            with self.running(what):
                found = stack.enter_context(context)
            yield found
            with self.running(what):
                stack.close()


def cost(folder: Path, spec: Path) -> bool:
    """Print what a run spends on hashes, checkpoints, locks and the step; return whether it is less than 3 %."""
    from photonpano import load_spec, run

    plan, watch = load_spec(spec, output=folder / "run", overrides=["run.threads=2"]), Stopwatch()
    with ExitStack() as stack:
        stack.enter_context(mock.patch("os.fsync", watch.flush))
        for what, names in COSTS.items():
            for name in names:
                stack.enter_context(mock.patch(name, watch.timed(pkgutil.resolve_name(name), what)))
        start, used = time.perf_counter(), time.process_time()
        run(plan)
        whole_s, used_s = time.perf_counter() - start, time.process_time() - used
    least_s = used_s / 2
    for what, seconds in watch.seconds.items():
        print(f"{what}: {seconds:.2f} s, {seconds / least_s:.2%}")
    share = watch.seconds.total() / least_s
    print(f"together {watch.seconds.total():.2f} s, {share:.2%} of the {least_s:.1f} s that two cores need at least")
    print(f"the run took {whole_s:.1f} s")
    return share < 0.03


def main(spec: Path) -> bool:
    """Measure the run of a spec."""
    with passing() as study:
        preload()
        prepare(study.folder)
        warm_up(study.folder)
        return not cost(study.folder, spec)


if __name__ == "__main__":
    command(main)
