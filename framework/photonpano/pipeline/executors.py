"""Build the executor of a run, and open the capture in the processes of its workers."""

from __future__ import annotations

import importlib.metadata
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from photonpano.contributions import ExecutorContext
from photonpano.execution import CaptureElsewhere, Executor, Here
from photonpano.motion.attributed_source import AttributedSource
from photonpano.pipeline.components import build_source, built
from photonpano.protocols import Source
from photonpano.record.environment import library_versions, plugin_records
from photonpano.source_wrapper import SourceWrapper
from photonpano.specs.loading import parse_spec
from photonpano.specs.plan import Plan
from photonpano.threads import thread_count


@contextmanager
def executor_of(plan: Plan, source: Source) -> Iterator[Executor]:
    """Build the executor of a plan, and close it at the end of the block.

    Raises:
        InputError: there are no workers, or they do not have what the run needs.
        PluginError: a library is missing, or the plugin failed in its own way.
    """
    if plan.executor is None:
        yield Here(thread_count(plan.run.threads))
        return
    document = {key: plan.document[key] for key in ("version", "source")} | {"run": {"seed": plan.run.seed}}
    capture = CaptureElsewhere(as_read(source), CaptureOpener(json.dumps(document, sort_keys=True)))
    names = ("photonpano", *library_versions(plan), *(each["plugin"] for each in plugin_records(plan)))
    versions = InstalledVersions(tuple(dict.fromkeys(names)))
    executor: Executor = built(plan.executor, ExecutorContext(thread_count(plan.run.threads), capture, versions))
    try:
        yield executor
    finally:
        executor.close()


def as_read(source: Source) -> Source:
    """Return the capture without what the framework does to it."""
    while isinstance(source, SourceWrapper) and not isinstance(source, AttributedSource):
        source = source.wrapped
    return source


@dataclass(frozen=True, slots=True)
class CaptureOpener:
    """Opens a capture in another process.

    Attributes:
        document: the sections of a resolved spec that name it, as JSON.
    """

    document: str

    def __call__(self) -> Source:
        """Open the capture."""
        import cv2

        # A worker is one of many processes, each with a core.
        cv2.setNumThreads(1)
        plan = parse_spec(json.loads(self.document) | {"corrections": []}, output="unused")
        return as_read(build_source(replace(plan, corrections=())))


@dataclass(frozen=True, slots=True)
class InstalledVersions:
    """Tells which versions of some distributions a process has.

    Attributes:
        names: of the distributions; "python" stands for itself.
    """

    names: tuple[str, ...]

    def __call__(self) -> dict[str, str]:
        """Return the versions by name."""
        return {name: _version(name) for name in self.names}


def _version(name: str) -> str:
    if name == "python":
        return sys.version.split()[0]
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
