"""Build the executor of a run, and open the capture in the processes of its workers."""

from __future__ import annotations

import importlib.metadata
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from uuid import uuid4

from photonpano.capture import Capture, PluginSource, capture_of
from photonpano.contracts.protocols import Source
from photonpano.errors import InputError, PhotonpanoError
from photonpano.execution import CaptureElsewhere, Executor, LocalExecutor, differences
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.pipeline.components import build_source, built
from photonpano.plugins.contributions import ExecutorContext
from photonpano.record.contents import frames_sha256
from photonpano.record.run_json import library_versions, plugin_records
from photonpano.specs.loading import parse_spec
from photonpano.specs.plan import Plan


@contextmanager
def executor_of(plan: Plan, source: Source) -> Iterator[Executor]:
    """Build the executor of a plan, and close it at the end of the block; `InputError` if workers lack what the run needs."""
    if plan.executor is None:
        yield LocalExecutor(thread_count(plan.run.threads))
        return
    read = capture_of(source).source  # as its plugin gives it: it is opened anew in each process
    names = ("photonpano", *library_versions(plan), *(each["plugin"] for each in plugin_records(plan)))
    here = met_by(dict.fromkeys(names), read)
    # Not the document, which hides the passwords of URLs.
    keys = plan.source.config.model_dump(exclude_unset=True, by_alias=True)
    opener = CaptureOpener(uuid4().hex, plan.run.seed, plan.source.contribution.name, keys, here)
    context = ExecutorContext(
        thread_count(plan.run.threads), CaptureElsewhere(read, opener), here=here, elsewhere=partial(met_elsewhere, opener)
    )
    executor: Executor = built(plan.executor, context)
    try:
        yield executor
    finally:
        executor.close()


@dataclass(frozen=True, slots=True)
class CaptureOpener:
    """Opens a capture in another process, for the tasks of one run."""

    run: str  # unique ID of the run: workers may outlive a run, and files may change
    seed: int = field(compare=False)
    source: str = field(compare=False)
    keys: Mapping[str, Any] = field(compare=False)
    needed: Mapping[str, str] = field(compare=False)  # what the run needs, as `met_by` returns it

    def __call__(self) -> PluginSource:
        """Open the capture. From then on, the libraries of the process work in one thread: workers are many processes.

        Raises `InputError` in a process that joined the cluster late, and does not have what the run needs.
        """
        source = self.unchecked()
        if different := differences(self.needed, met_by(self.needed, source)):
            raise InputError(f"a worker that joined during the run differs from the process that runs it: {different}")
        return source

    def unchecked(self) -> PluginSource:
        """Open the capture, whatever this process has."""
        _WHILE_THE_PROCESS_LIVES.enter_context(one_thread_inside())
        spec = {"version": 1, "source": {"use": self.source, "with": self.keys}, "corrections": [], "run": {"seed": self.seed}}
        return build_source(parse_spec(spec, output="unused")).source


_WHILE_THE_PROCESS_LIVES = ExitStack()


def met_elsewhere(opener: CaptureOpener) -> dict[str, str]:
    """Return what another process has of what a run needs; of a capture that it cannot open, why."""
    try:
        source = opener.unchecked()
    except PhotonpanoError as error:
        return met_by(opener.needed, None) | {"capture": str(error)}
    return met_by(opener.needed, source)


def met_by(needed: Iterable[str], source: PluginSource | None) -> dict[str, str]:
    """Return what this process has of what a run needs: versions of distributions by name, and a hash of the capture."""
    return {name: _version(name) for name in needed if name != "capture"} | {
        "capture": "" if source is None else frames_sha256(Capture(source, source.info, source.valid))[:12]
    }


def _version(name: str) -> str:
    if name == "python":
        return sys.version.split()[0]
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
