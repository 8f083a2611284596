"""Observers are told all, change nothing, and do no harm."""

from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from photonpano import LocationError, hookimpl
from photonpano.errors import described
from photonpano.execution.context import Context
from photonpano.geometry import Canvas
from photonpano.motion.level import Timeline
from photonpano.motion.locate import LoopSetting
from photonpano.motion.loop import estimate_motion
from photonpano.pipeline.observers import Observers, frozen
from photonpano.plugins.registry import Catalog
from photonpano.specs.settings import GraphSettings

DIRECTORY = Path("runs/scan")


def plugin(name: str = "watcher", **hooks: Callable[..., None]) -> ModuleType:
    """Make a plugin with these hooks, named without their prefix."""
    module = ModuleType(name)
    for hook, function in hooks.items():
        setattr(module, f"photonpano_{hook}", hookimpl(function))
    return module


def watching(*plugins: ModuleType) -> Observers:
    return Observers(Catalog().including(*plugins).observers, DIRECTORY)


@pytest.fixture
def told() -> list[Any]:
    return []


@pytest.fixture
def log(told: list[Any]) -> ModuleType:
    """A plugin that writes down in `told` what it is told."""
    return plugin(
        run_started=lambda directory, spec: told.append((directory, spec)),
        stage_finished=lambda level, stage, seconds, summary: told.append((level, stage, seconds, dict(summary))),
        run_finished=lambda directory, record, error: told.append((directory, record, error)),
    )


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (LocationError("level 1: lost"), "LocationError: level 1: lost"),
        (ZeroDivisionError("a defect"), "ZeroDivisionError: a defect"),
        (KeyboardInterrupt(), "KeyboardInterrupt"),
    ],
    ids=repr,
)
def test_failed_run_raises_its_error_and_reports_it(
    told: list[Any], log: ModuleType, error: BaseException, message: str
) -> None:
    with pytest.raises(type(error)) as caught, watching(log).watching({}):
        raise error
    assert caught.value is error
    assert told[1:] == [(DIRECTORY, None, message)]


def test_observers_receive_four_stages_of_each_level(
    told: list[Any], log: ModuleType, memory_source: type, make_level: Callable
) -> None:
    source = memory_source(np.zeros((120, 40, 60)))
    levels = [make_level(), make_level(number=2)]
    context = Context(threads=2, on_level=watching(log).level_finished)
    setting = LoopSetting(source=source, graph=GraphSettings(), context=context, reference=60, timeline=Timeline.regular(120))
    results = estimate_motion(setting, levels)
    assert [(level, stage) for level, stage, _, _ in told] == [
        (level, stage) for level in (1, 2) for stage in ("resample", "merge", "locate", "interpolate")
    ]
    assert [seconds for _, _, seconds, _ in told] == [
        result.seconds[stage] for result in results for stage in ("resample", "merge", "locate", "interpolate")
    ]
    summaries = [summary for *_, summary in told]
    assert summaries[:3] == [
        {"groups": 12},
        {"exposures": 12},
        {"pairs": len(results[0].located.edges), "failed": 0, "located": 12},
    ]
    assert summaries[3] == {"change_px": None, "std_px": results[0].uncertainty.mean_px}
    assert summaries[7] == {"change_px": results[1].change_px, "std_px": results[1].uncertainty.mean_px}


def test_exception_of_observer_is_logged_with_its_name_and_others_are_called(
    told: list[Any], log: ModuleType, caplog: pytest.LogCaptureFixture
) -> None:
    error = ValueError("no space")

    def fail(directory: Path) -> None:
        raise error

    observers = watching(plugin("clumsy", run_started=fail, stage_finished=fail, run_finished=fail), log)
    with observers.watching({}) as finished:
        observers.rendered(Canvas(30, 40, np.eye(3)), 2.5)
        finished({})
    assert len(told) == 3
    assert caplog.messages == [
        f"photonpano_{hook} of clumsy unreleased (given in Python) raised {described(error)}; the run goes on"
        for hook in ("run_started", "stage_finished", "run_finished")
    ]
    assert all(record.exc_info and record.exc_info[1] is error for record in caplog.records)


def test_frozen_data_cannot_be_changed() -> None:
    spec = {"run": {"seed": 3}, "levels": [{"scale": 1.0}]}
    seen = frozen(spec)
    assert seen == {"run": {"seed": 3}, "levels": ({"scale": 1.0},)}
    for change in (
        lambda: seen.update(seed=4),
        lambda: seen["run"].__setitem__("seed", 4),
        lambda: seen["levels"].append({}),
        lambda: seen["levels"][0].__setitem__("scale", 2.0),
    ):
        with pytest.raises((TypeError, AttributeError)):
            change()
    spec["run"]["seed"] = 5
    assert seen["run"]["seed"] == 3
