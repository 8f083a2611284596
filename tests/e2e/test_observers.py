"""Installed observers see successful and failed runs, and cannot change them."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from ruamel.yaml import YAML
from typer.testing import CliRunner

from photonpano.api.cli.app import app

pytestmark = pytest.mark.usefixtures("without_report")

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "follow-runs.md"
CLUMSY = """
from photonpano import hookimpl

@hookimpl
def photonpano_run_started(spec):
    spec["run"]["seed"] = 1

@hookimpl
def photonpano_stage_finished(level, stage):
    if stage == "locate":
        raise RuntimeError(f"no space at level {level}")

@hookimpl
def photonpano_run_finished(record):
    raise OSError("no space")
"""


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, str], None]]:
    """Install a distribution of version 1.0 with one module, as a folder on `sys.path` with a `.dist-info`."""
    monkeypatch.syspath_prepend(tmp_path)

    def install(name: str, code: str) -> None:
        (tmp_path / f"{name}_hooks.py").write_text(code)
        info = tmp_path / f"{name}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[photonpano]\n{name} = {name}_hooks\n")
        importlib.invalidate_caches()

    yield install
    for module in [name for name in sys.modules if name in ("logger_hooks", "clumsy_hooks")]:
        del sys.modules[module]


@pytest.fixture
def logger(install: Callable[[str, str], None]) -> None:
    """The plugin of docs/how-to/follow-runs.md."""
    (code,) = re.findall(
        r"<!-- file: photonpano_progress.py -->\n```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL
    )
    install("logger", code)


@pytest.fixture
def run(tiny_spec: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    monkeypatch.chdir(tmp_path)
    with (tmp_path / "scan.yaml").open("w") as file:
        YAML().dump(tiny_spec, file)
    return lambda *arguments, **environment: CliRunner().invoke(app, ["run", "scan.yaml", *arguments], env=environment)


def lines(name: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in Path(f"runs/{name}.progress.jsonl").read_text().splitlines()]


@pytest.mark.usefixtures("logger")
def test_failing_observer_is_a_warning_and_changes_no_result(
    run: Callable[..., Result], install: Callable[[str, str], None]
) -> None:
    install("clumsy", CLUMSY)
    result = run("--output", "runs/watched")
    assert result.exit_code == 0
    started, located, finished, *_ = result.stderr.splitlines()
    who = "of clumsy 1.0 (clumsy = clumsy_hooks) raised"
    what = "TypeError: 'mappingproxy' object does not support item assignment"
    assert started == f"warning: photonpano_run_started {who} {what}; the run goes on"
    assert located == f"warning: photonpano_stage_finished {who} RuntimeError: no space at level 1; the run goes on"
    assert finished == f"warning: photonpano_run_finished {who} OSError: no space; the run goes on"
    assert [line["event"] for line in lines("watched")] == ["started", *["stage"] * 5, "done"]

    alone = run("--output", "runs/alone", PHOTONPANO_DISABLE_PLUGINS="clumsy,logger")
    assert alone.exit_code == 0
    assert "raised" not in alone.stderr
    assert not Path("runs/alone.progress.jsonl").exists()
    with np.load("runs/watched/trajectory.npz") as watched, np.load("runs/alone/trajectory.npz") as unwatched:
        np.testing.assert_array_equal(watched["homographies"], unwatched["homographies"])
    assert json.loads(Path("runs/watched/run.json").read_text())["seed"] == 0
