"""Build the executor of a run, and open the capture in the processes of its workers."""

from __future__ import annotations

import importlib.metadata
import platform
import sys
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import Executor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from uuid import uuid4

from photonpano.capture import Capture, PluginSource, capture_of
from photonpano.contracts.protocols import Source
from photonpano.errors import InputError, PhotonpanoError
from photonpano.execution.context import Context
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.pipeline.components import build_source, built
from photonpano.plugins.contributions import ExecutorContext
from photonpano.record.contents import frames_sha256
from photonpano.record.run_json import library_versions, plugin_records
from photonpano.specs.loading import parse_spec
from photonpano.specs.plan import Plan


@contextmanager
def on_executor(plan: Plan, source: Source, context: Context) -> Iterator[Context]:
    """Yield a context with the executor of a plan, or with threads; the executor is shut down at the end of the block."""
    threads = thread_count(plan.run.threads)
    if plan.executor is None:
        yield replace(context, threads=threads)
        return
    read = capture_of(source).source  # as its plugin gives it: it is opened anew in each process
    names = ("photonpano", *library_versions(plan), *(each["plugin"] for each in plugin_records(plan)))
    # Not the document, which hides the passwords of URLs.
    keys = plan.source.config.model_dump(exclude_unset=True, by_alias=True)
    read.opener = CaptureOpener(uuid4().hex, plan.run.seed, plan.source.contribution.name, keys, met_by(names, read))
    executor: Executor = built(plan.executor, ExecutorContext(threads))
    try:
        yield replace(context, threads=getattr(executor, "under_way", threads), executor=executor)
    finally:
        executor.shutdown(cancel_futures=True)


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

        Raises `InputError` in a process that does not have what the run needs.
        """
        _WHILE_THE_PROCESS_LIVES.enter_context(one_thread_inside())
        spec = {"version": 1, "source": {"use": self.source, "with": self.keys}, "corrections": [], "run": {"seed": self.seed}}
        try:
            source = build_source(parse_spec(spec, output="unused")).source
        except PhotonpanoError as error:
            found = met_by(self.needed, None) | {"capture": str(error)}
        else:
            found = met_by(self.needed, source)
        different = [f"{name} {found[name]} (here {here})" for name, here in self.needed.items() if found[name] != here]
        if different:
            raise InputError(
                f"a worker on {platform.node()} differs from the process of the run: {', '.join(different)}; it needs the same "
                "versions, and must find the same capture at its path, since results must not depend on the worker"
            )
        return source


_WHILE_THE_PROCESS_LIVES = ExitStack()


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
