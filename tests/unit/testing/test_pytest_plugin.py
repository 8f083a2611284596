"""The kit inside pytest: it is registered, and its subclasses are collected."""

from __future__ import annotations

import subprocess
import sys

import pytest

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
    result.assert_outcomes(passed=18, failed=2)
    result.stdout.fnmatch_lines(
        ["*AssertionError: groups() must raise an InputError if a capture is too short; with 1 frames it raised Value*"]
    )


def test_pytest_plugin_imports_pytest_only():
    code = (
        "import sys, pytest; before = set(sys.modules); import photonpano.testing.pytest_plugin; "
        "print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    package = ["lazy_loader", "photonpano", "photonpano.testing", "photonpano.testing.pytest_plugin"]
    assert done.stdout.split() == package


def test_package_does_not_import_pytest():
    code = "import sys, photonpano, photonpano.testing, photonpano.cli; sys.exit('pytest' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_pytest_plugin_is_registered(request):
    assert request.config.pluginmanager.has_plugin("photonpano")
