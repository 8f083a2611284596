"""Run single checks of the kit on components, most of them broken on purpose, and a small capture with them."""

import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from photonpano import FrameSpan, SourceContribution, StageContext
from photonpano.api.cli.errors import reported
from photonpano.geometry import camera_matrix, translation
from photonpano.pipeline.run import run
from photonpano.plugins.contributions import KINDS as OF_CATALOG
from photonpano.plugins.registry import Catalog, Observer, discover, make_entry
from photonpano.specs import parse_spec
from photonpano.testing import KnownMotion, MemorySource, Scene
from photonpano.testing.captures import recorded
from photonpano_poses import PosedView, PoseEstimate, PoseEstimatorContribution, ScenePoints, testing

from .strange import FRAMES, KINDS, ORIGIN, SHAPE, Keys, Outcome


def cases(check: Callable, kit: Any) -> Iterator[dict[str, Any]]:
    """Yield the arguments with which pytest would call a check."""
    given = {mark.args[0]: mark.args[1] for mark in getattr(check, "pytestmark", ()) if mark.name == "parametrize"}
    if "motion" in inspect.signature(check).parameters:
        given["motion"] = kit.motions
    yield from (dict(zip(given, values, strict=True)) for values in product(*given.values()))


@pytest.fixture
def fails(tmp_path: Path) -> Callable[..., bool]:
    """Run a check of the kit on the component that `build(context)` returns, and return whether it fails.

    `record` holds fields of the contribution; other keywords are attributes of the class of the kit.
    """

    def fails(kit: type, check: str, build: Any, record: dict[str, Any] | None = None, **attributes: Any) -> bool:
        fields = {"name": "toy", "summary": "A toy", "config": Keys, "build": lambda _, context: build(context)}
        contribution = OF_CATALOG[kit.kind].contribution(**fields | (record or {}))
        subject = type("TestToy", (kit,), {"contribution": contribution, **attributes})()
        if hasattr(subject, "prepare"):
            subject.prepare(tmp_path)
        try:
            for arguments in cases(getattr(subject, check), subject):
                getattr(subject, check)(**arguments)
        except (Exception, pytest.fail.Exception):
            return True
        return False

    return fails


class KnownPath:
    """A pose estimator that knows the path of the camera; one view shows three points."""

    def __init__(self, poses: np.ndarray, matrix: np.ndarray, shape: tuple[int, int]) -> None:
        n_frames, located = len(poses), np.ones(len(poses), np.bool_)
        points = ScenePoints(np.array([[0.0, 0, 4], [1, 0, 5], [0, 1, 6]]), np.full(3, 0.5, np.float32))
        flux = np.full(shape, 0.5, np.float32)
        view = PosedView(FrameSpan(0, 40), 20, poses[20], np.arange(3), np.full((3, 2), 20.0), lambda: flux)
        std = 0.001 * np.sqrt(3) * np.ones(n_frames), 0.01 * np.ones(n_frames)
        self.known = PoseEstimate(matrix, np.zeros(4), 0.0, poses, located, *std, points, (view,), (), (), ())

    def estimate(self, *_: Any) -> PoseEstimate:
        return self.known


def known_path(context: StageContext) -> KnownPath:
    """Build the pose estimator for the capture of a run, in which the camera moves straight, or for that of the kit."""
    if context.stream.frame_shape == SHAPE:
        poses = np.tile(np.eye(3, 4), (FRAMES, 1, 1))
        poses[:, 0, 3] = -np.linspace(0, 1, FRAMES)
        return KnownPath(poses, camera_matrix(60, (31.5, 23.5)), SHAPE)
    poses = testing.true_poses()
    poses[:, :, 3] += 0.001 * np.random.default_rng(0).normal(size=(len(poses), 3))
    return KnownPath(poses, camera_matrix(testing.FOCAL_PX, (79.5, 63.5)), testing.POSES_SHAPE)


@pytest.fixture(scope="package")
def frames() -> np.ndarray:
    """(160, 48, 64) frames of a pan of 24 px."""
    return recorded(Scene(), KnownMotion(lambda frame: translation(0.15 * frame, 0.05 * frame)), FRAMES, SHAPE)


@pytest.fixture(scope="package")
def catalog(frames: np.ndarray) -> Catalog:
    memory = SourceContribution(name="memory", summary="Frames in memory", config=Keys, build=lambda *_: MemorySource(frames))
    known = PoseEstimatorContribution(
        name="known-path", summary="A straight path", config=Keys, build=lambda _, context: known_path(context)
    )
    return discover().including(memory).including(known)


@pytest.fixture
def outcome_of(catalog: Catalog, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Run the small capture as the command line does, with contributions of a strange plugin, over an earlier run."""
    earlier = tmp_path / "run" / "panorama.png"

    def outcome_of(sections: Mapping[str, Any], *contributions: Any, observers: tuple[Observer, ...] = ()) -> Outcome:
        rows = (*catalog.rows, *(make_entry(each, ORIGIN) for each in contributions))
        spec: dict[str, Any] = {"version": 1, "source": {"use": "memory"}, "corrections": []}
        if "pose" not in sections:
            spec |= {"resample": {"use": "midpoint", "with": {"group_size": 40}}, "levels": 1, "refine": []}
        code, record = 0, None
        earlier.parent.mkdir(exist_ok=True)
        earlier.write_text("of an earlier run")
        try:
            with reported():
                plan = parse_spec(spec | sections, output=tmp_path / "run", catalog=replace(catalog, rows=rows))
                record = run(replace(plan, observers=observers), overwrite=True).record
        except typer.Exit as ended:
            code = ended.exit_code
        kept = earlier.read_bytes() == b"of an earlier run"
        files = sorted(each.name for each in earlier.parent.iterdir() if not (kept and each == earlier))
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
        chosen: Any = {"use": "strange", "with": {"group_size": 40} if kind == "resampler" else {}}
        return outcome_of({section: [chosen] if kind == "refiner" else chosen} | sections, strange)

    return misbehaving
