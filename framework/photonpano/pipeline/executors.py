"""Build the executor of a run, and open the capture in the processes of its workers."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any
from uuid import uuid4

from photonpano.contributions import ExecutorContext
from photonpano.errors import PhotonpanoError
from photonpano.execution import CaptureElsewhere, Executor, Here
from photonpano.execution.remote import opened
from photonpano.motion.attributed_source import AttributedSource
from photonpano.pipeline.components import build_source, built
from photonpano.protocols import Source
from photonpano.record.environment import library_versions, plugin_records
from photonpano.source_wrapper import SourceWrapper
from photonpano.specs.loading import parse_spec
from photonpano.specs.plan import Plan
from photonpano.threads import thread_count
from photonpano.values import FrameSpan


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
    # Workers may live longer than a run, and files change: each run has the capture opened anew.
    opener = CaptureOpener(json.dumps(document, sort_keys=True), uuid4().hex)
    names = ("photonpano", *library_versions(plan), *(each["plugin"] for each in plugin_records(plan)))
    needs = Needs(tuple(dict.fromkeys(names)), opener)
    context = ExecutorContext(thread_count(plan.run.threads), CaptureElsewhere(as_read(source), opener), needs)
    executor: Executor = built(plan.executor, context)
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
        run: distinguishes the run.
    """

    document: str
    run: str

    def __call__(self) -> Source:
        """Open the capture."""
        import cv2

        # A worker is one of many processes, each with a core.
        cv2.setNumThreads(1)
        plan = parse_spec(json.loads(self.document) | {"corrections": []}, output="unused")
        return as_read(build_source(replace(plan, corrections=())))


@dataclass(frozen=True, slots=True)
class Needs:
    """Tells what a process has of what a run needs: versions of distributions, and the capture.

    Attributes:
        names: of the distributions; "python" stands for itself.
        opener: opens the capture.
    """

    names: tuple[str, ...]
    opener: CaptureOpener

    def __call__(self) -> dict[str, str]:
        """Return versions by name, and a hash of some frames of the capture, or why it cannot be opened."""
        try:
            capture = _hash_of(opened(self.opener))
        except PhotonpanoError as error:
            capture = str(error)
        return {name: _version(name) for name in self.names} | {"capture": capture}


def _hash_of(source: Any) -> str:
    """Return a hash of what describes a capture, and of its first, middle and last frame."""
    digest, last = hashlib.sha256(repr(source.info).encode()), source.info.n_frames - 1
    for frame in (0, last // 2, last):
        digest.update(source.counts(FrameSpan(frame, frame + 1)).tobytes())
    return digest.hexdigest()[:12]


def _version(name: str) -> str:
    if name == "python":
        return sys.version.split()[0]
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
