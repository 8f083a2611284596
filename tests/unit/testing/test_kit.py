"""The kit itself: scenes, executors, and the plugin of pytest."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from photonpano import Config, ExecutorContribution
from photonpano.testing import ExecutorConformance, KnownMotion, Scene, photographed, recorded
from photonpano.testing.executors import N_FRAMES, capture

SHAPE = (30, 44)
STILL = KnownMotion(lambda _: np.eye(3))


def test_recorded_frames_follow_detection_model():
    scene = Scene()
    frames = recorded(scene, STILL, 150, SHAPE)
    known = -np.expm1(-scene.view(np.eye(3), SHAPE))
    z = (frames.mean(axis=0) - known) / np.sqrt(known * (1 - known) / 150)
    assert abs(z.mean()) * np.sqrt(z.size) < 4
    assert z.std() == pytest.approx(1, abs=0.1)


def test_photographed_exposure_has_photon_noise():
    known = Scene().view(np.eye(3), SHAPE)
    unseen = np.zeros(SHAPE, bool)
    unseen[3] = True
    exposure = photographed(known, n_frames=2000, unseen=unseen)
    np.testing.assert_array_equal(np.isnan(exposure.flux), unseen)
    np.testing.assert_array_equal(exposure.weight, np.where(unseen, 0, 2000))
    z = (exposure.flux - known) / np.sqrt(np.expm1(known) / 2000)
    assert np.nanstd(z) == pytest.approx(1, abs=0.1)


class NoConfig(Config):
    pass


class Mute(ThreadPoolExecutor):
    """Swallows errors."""

    def submit(self, work, *given):
        done = super().submit(work, *given)
        return super().submit(str) if done.exception() else done


class Stale(ThreadPoolExecutor):
    """Reads another capture."""

    def submit(self, work, *given):
        done = super().submit(work, *given)
        return super().submit(np.add, done.result(), 1) if given[0] is capture() else done


class Unordered(ThreadPoolExecutor):
    """Takes the first items for all."""

    def submit(self, work, *given):
        self.first = getattr(self, "first", given)
        return super().submit(work, *self.first)


@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (Mute, "test_error_of_a_task_arrives"),
        (Stale, "test_task_sees_the_capture"),
        (Unordered, "test_results_come_in_order"),
    ],
)
def test_broken_executor_is_found(broken: type[ThreadPoolExecutor], check: str) -> None:
    class Checks(ExecutorConformance):
        contribution = ExecutorContribution(
            name="broken", summary="Breaks a promise", config=NoConfig, build=lambda _, context: broken(context.threads)
        )

    getattr(Checks(), check)(ThreadPoolExecutor(2))
    with pytest.raises((AssertionError, TypeError, pytest.fail.Exception)):
        getattr(Checks(), check)(broken(2))
    assert capture().info.n_frames == N_FRAMES


pytest_plugins = ["pytester"]

TOY = """
from photonpano import Config, FrameSpan, Group, ResamplerContribution


class Halves:
    def groups(self, n_frames, level):
        half = n_frames // 2
        spans = (FrameSpan(0, half), FrameSpan(half, n_frames))
        return tuple(Group(span, span.centre) for span in spans)


class HalvesConfig(Config):
    pass


HALVES = ResamplerContribution(
    name="halves",
    summary="Two groups, whatever the level",
    config=HalvesConfig,
    build=lambda config, context: Halves(),
)
"""
TESTS = """
from photonpano.testing import ResamplerConformance
from toy import HALVES


class TestHalves(ResamplerConformance):
    contribution = HALVES
"""


@pytest.mark.filterwarnings("default::pytest.PytestAssertRewriteWarning")  # this pytest has imported the kit before
def test_subclass_is_collected_and_reports_failure(pytester, monkeypatch):
    pytester.syspathinsert()
    pytester.makepyfile(toy=TOY, test_toy=TESTS)
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider")
    result.assert_outcomes(passed=7, failed=1)
    result.stdout.fnmatch_lines(["*ValueError: a frame span needs 0 <= start < stop, got *"])


def test_pytest_plugin_imports_pytest_only():
    code = (
        "import sys, pytest; before = set(sys.modules); import photonpano.testing.pytest_plugin; "
        "print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    package = ["lazy_loader", "photonpano", "photonpano.testing", "photonpano.testing.pytest_plugin"]
    assert done.stdout.split() == package
