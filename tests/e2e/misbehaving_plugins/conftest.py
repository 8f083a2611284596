"""Run a small capture with components of a strange plugin, as the command line does."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from photonpano import FrameSpan, PosedView, PoseEstimate, PoseEstimatorContribution, ScenePoints, SourceContribution
from photonpano.cli.errors import reported
from photonpano.geometry import translation
from photonpano.pipeline.run import run
from photonpano.registry import Catalog, Observer, discover
from photonpano.registry.catalog import make_entry
from photonpano.specs import parse_spec
from photonpano.testing import KnownMotion, MemorySource, Scene
from photonpano.testing.captures import recorded

from .strange import FRAMES, KINDS, ORIGIN, SHAPE, Keys, Outcome


class KnownPath:
    """A pose estimator that knows the path of the camera: straight, before three points that one view shows."""

    def estimate(self, *_: Any) -> PoseEstimate:
        poses = np.tile(np.eye(3, 4), (FRAMES, 1, 1))
        poses[:, 0, 3] = -np.linspace(0, 1, FRAMES)
        points = ScenePoints(np.array([[0.0, 0, 4], [1, 0, 5], [0, 1, 6]]), np.full(3, 0.5, np.float32))
        flux = np.full(SHAPE, 0.5, np.float32)
        view = PosedView(FrameSpan(0, 40), 20, poses[20], np.arange(3), np.full((3, 2), 20.0), lambda: flux)
        matrix, nothing = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]), np.zeros(FRAMES)
        located = np.ones(FRAMES, np.bool_)
        return PoseEstimate(matrix, np.zeros(4), 0.0, poses, located, nothing, nothing, points, (view,), (), ())


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    """(160, 48, 64) frames of a pan of 24 px."""
    return recorded(Scene(), KnownMotion(lambda frame: translation(0.15 * frame, 0.05 * frame)), FRAMES, SHAPE)


@pytest.fixture(scope="module")
def catalog(frames: np.ndarray) -> Catalog:
    memory = SourceContribution(name="memory", summary="Frames in memory", config=Keys, build=lambda *_: MemorySource(frames))
    known = PoseEstimatorContribution(name="known-path", summary="A straight path", config=Keys, build=lambda *_: KnownPath())
    return discover().including(memory).including(known)


@pytest.fixture(autouse=True)
def as_the_program(heeded: None, without_report: None) -> None:
    """Handle SIGINT as the program does, and leave the report out, which takes longer than the rest of a small run."""


@pytest.fixture
def outcome_of(catalog: Catalog, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Run the small capture as the command line does, with contributions of a strange plugin."""

    def outcome_of(sections: Mapping[str, Any], *contributions: Any, observers: tuple[Observer, ...] = ()) -> Outcome:
        rows = (*catalog.rows, *(make_entry(each, ORIGIN) for each in contributions))
        spec: dict[str, Any] = {"version": 1, "source": {"use": "memory"}, "corrections": []}
        if "pose" not in sections:
            spec |= {"resample": {"use": "midpoint", "with": {"group_size": 40}}, "levels": 1, "refine": []}
        code, record = 0, None
        try:
            with reported():
                plan = parse_spec(spec | sections, output=tmp_path / "run", catalog=replace(catalog, rows=rows))
                record = run(replace(plan, observers=observers)).record
        except typer.Exit as ended:
            code = ended.exit_code
        files = sorted(each.name for each in (tmp_path / "run").glob("*"))
        return Outcome(code, capsys.readouterr().err, files, record)

    return outcome_of


@pytest.fixture
def misbehaving(catalog: Catalog, outcome_of: Callable[..., Outcome]) -> Callable[..., Outcome]:
    """Run with a strange component of a kind: `change` makes it of a good one."""

    def misbehaving(kind: str, change: Callable[[Any], Any], **sections: Any) -> Outcome:
        section, contribution, good = KINDS[kind]
        inner = catalog.find(kind, good).contribution
        strange = contribution(
            name="strange",
            summary="Strange",
            config=inner.config,
            build=lambda config, context: change(inner.build(config, context)),
        )
        keys = {"group_size": 40} if kind == "resampler" else {}
        chosen: Any = {"use": "strange", "with": keys}
        return outcome_of({section: [chosen] if kind == "refiner" else chosen} | sections, strange)

    return misbehaving
