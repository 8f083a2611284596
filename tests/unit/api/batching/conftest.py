"""Jobs that end in odd ways, for workers that are real processes."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

MODULE = """\
import itertools, os, signal, time
from dataclasses import dataclass, field
from pathlib import Path
from photonpano.api.batching.sweeps import Job
from photonpano.api.batching.sweeps import SpecText
from photonpano.atomic import atomic_path
from photonpano.record.batch_row import BatchRow

@dataclass(frozen=True)
class Odd(SpecText):
    ending: str = ""

    def plan(self, overrides, output, catalog=None):
        if self.ending:
            Path(f"{output}.pid").write_text(f"{os.getpid()} {os.getppid()}")
            print("printed by a library", flush=True)
            with atomic_path(Path(f"{output}.file")):
                exec(self.ending)
        return super().plan(overrides, output, catalog)

def job(ending, folder, spec=""):
    name = f"job-{abs(hash(ending))}"
    row = BatchRow(name, folder / "absent.npy", {}, folder / name)
    return Job(row, Odd(spec or "version: 1", folder, None, ending), (), 1)
"""


@pytest.fixture
def odd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """A module that processes import: `odd.job(ending, folder)` is a job that runs a line of Python."""
    (tmp_path / "odd_jobs.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("odd_jobs")
    del sys.modules["odd_jobs"]
