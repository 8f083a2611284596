"""The kit itself: scenes, executors, and the plugin of pytest."""

import subprocess
import sys

import numpy as np
import pytest

from photonpano import Config, ExecutorContribution, FrameSpan, InputError, LocationError
from photonpano.execution import LocalExecutor
from photonpano.geometry import translation
from photonpano.testing import ExecutorConformance, KnownMotion, MemorySource, Scene, photographed, recorded
from photonpano.testing.captures import ReadOnlySource
from photonpano.testing.conformance import fingerprint, in_threads
from photonpano.testing.executors import N_FRAMES, capture

SHAPE = (30, 44)
STILL = KnownMotion(lambda _: np.eye(3))


def test_scene_view_moved_by_whole_pixels_has_same_values():
    scene = Scene()
    here, there = scene.view(np.eye(3), SHAPE), scene.view(translation(3, -2), SHAPE)
    np.testing.assert_allclose(there[2:, :-3], here[:-2, 3:], rtol=1e-9)


def test_scene_view_is_the_flux_at_the_points_that_pixels_see():
    points = {"affine": [[34.2, 10.6], [36.8, 10.2]], "perspective": [[34.2, 10.6], [36.8 / 1.01, 10.2 / 1.01]]}
    for name, bend in (("affine", 0), ("perspective", 0.01)):
        seen = Scene().view(np.array([[2.6, 0.4, 33], [-0.4, 1.8, 5.2], [bend, 0, 1]]), SHAPE)
        np.testing.assert_allclose(seen[3, :2], Scene().flux(points[name]), rtol=1e-9)


def test_scene_flux_spans_given_range():
    flux = Scene(flux=(0.2, 0.7)).view(np.eye(3), (200, 200))
    assert 0.2 < flux.min() < 0.25
    assert 0.65 < flux.max() < 0.7


def test_scenes_of_different_seeds_are_uncorrelated():
    views = [Scene(seed).view(np.eye(3), (100, 100)).ravel() for seed in (0, 1)]
    assert abs(np.corrcoef(views)[0, 1]) < 0.2


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


@pytest.mark.parametrize("kind", [MemorySource, ReadOnlySource])
def test_memory_source_returns_its_frames(kind):
    frames = recorded(Scene(), STILL, 20, SHAPE)
    with kind(frames) as source:
        np.testing.assert_array_equal(source.frames(FrameSpan(3, 9)), frames[3:9])
        np.testing.assert_array_equal(source.counts(FrameSpan(3, 9)), frames[3:9].sum(axis=0))
        assert source.counts(FrameSpan(0, 1)).flags.writeable == (kind is MemorySource)
        with pytest.raises(InputError):
            source.counts(FrameSpan(19, 21))


def test_fingerprint_distinguishes_bytes():
    exposures = [photographed(np.full(SHAPE, 0.3), seed=seed) for seed in (0, 0, 1)]
    prints = [fingerprint({"of": [exposure, np.nan]}) for exposure in exposures]
    assert prints[0] == prints[1] != prints[2]
    assert fingerprint(np.zeros(2)) != fingerprint(np.zeros(2, np.float32))


def test_in_threads_runs_all_threads():
    assert in_threads(lambda number: number) == [0, 1, 2, 3]


class NoConfig(Config):
    pass


class Forgetful(LocalExecutor):
    """Keeps nothing."""

    def keep(self, work, *given):
        return None, work(*given)[1]


class Mute(LocalExecutor):
    """Swallows errors."""

    def call(self, work, *given):
        try:
            return work(*given)
        except LocationError:
            return None


class Stale(LocalExecutor):
    """Reads another capture."""

    def call(self, work, *given):
        done = work(*given)
        return done + 1 if given and given[0] is capture() else done


class Unordered(LocalExecutor):
    """Takes the last item for all."""

    def call(self, work, *given):
        return super().call(work, *((given[0], 19) if isinstance(given[0], dict) else given))


@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (Forgetful, "test_kept_results_are_given_to_other_tasks"),
        (Mute, "test_error_of_a_task_arrives"),
        (Stale, "test_task_sees_the_capture"),
        (Unordered, "test_shared_values_are_given_to_many_tasks"),
    ],
)
def test_broken_executor_is_found(broken: type[LocalExecutor], check: str) -> None:
    class Checks(ExecutorConformance):
        contribution = ExecutorContribution(
            name="broken", summary="Breaks a promise", config=NoConfig, build=lambda _, context: broken(context.threads)
        )

    getattr(Checks(), check)(LocalExecutor(2))
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


def test_package_does_not_import_pytest():
    code = "import sys, photonpano, photonpano.testing, photonpano.api.cli; sys.exit('pytest' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_pytest_plugin_is_registered(request):
    assert request.config.pluginmanager.has_plugin("photonpano")
