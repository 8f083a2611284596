"""A failing plugin is named with its distribution and the stage, and the run folder is not changed."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import (
    Config,
    FrameSpan,
    InterpolatorContribution,
    Located,
    LocatorContribution,
    MergerContribution,
    NotLocated,
    PluginError,
    ResamplerContribution,
    SourceContribution,
)
from photonpano.pipeline.run import run
from photonpano.registry import Catalog, Origin, discover
from photonpano.registry.catalog import make_entry
from photonpano.specs import parse_spec

pytestmark = pytest.mark.usefixtures("without_report")


class Fragile:
    """Any component whose method raises."""

    def fails(self, *_: Any) -> Any:
        raise RuntimeError("the cable came loose")

    groups = merge = describe = register = fit = fails


class FailsToRegister(Fragile):
    def describe(self, exposure: Any) -> None:
        return None

    register = Fragile.fails


class FindsNonsense(FailsToRegister):
    def register(self, moving: Any, fixed: Any, initial: Any) -> Located:
        return Located(np.full((3, 3), np.nan))


class FindsNothingMoved(FailsToRegister):
    """A locator that returns the identity, as after `except cv2.error: return np.eye(3)`: always, or from level 2 on."""

    def __init__(self, from_level: int, locator: Any = None) -> None:
        self.from_level, self.locator = from_level, locator

    def describe(self, exposure: Any) -> Any:
        return self.locator and self.locator.describe(exposure)

    def register(self, moving: Any, fixed: Any, initial: Any) -> Any:
        at_first = initial is None and self.from_level > 1
        return self.locator.register(moving, fixed, initial) if at_first else Located(np.eye(3))


class GivesNoGroups:
    def groups(self, n_frames: int, level: int) -> Any:
        return [(0, n_frames)]


class GivesNoExposure:
    def merge(self, *_: Any) -> Any:
        return np.zeros((128, 160))


class FailsLater:
    """An interpolator whose trajectory fails after the number of calls that fitting makes."""

    def __init__(self, answer: Callable[[Any], Any], good_for: int = 2) -> None:
        self.answer, self.good_for = answer, good_for

    def fit(self, instants: Any, homographies: Any, information: Any) -> FailsLater:
        self.instants, self.rows = instants, homographies.reshape(-1, 9).T
        return self

    def at(self, frames: Any) -> Any:
        self.good_for -= 1
        if self.good_for < 0:
            return self.answer(frames)
        return np.stack([np.interp(frames, self.instants, row) for row in self.rows], axis=-1).reshape(-1, 3, 3)


class FailsToRead:
    """A source with spans that cannot be read."""

    def __init__(self, source: Any, fails: Callable[[FrameSpan], bool], answer: Callable[..., Any]) -> None:
        self.source, self.fails, self.answer = source, fails, answer

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)

    def counts(self, span: FrameSpan) -> Any:
        return self.answer(self, span) if self.fails(span) else self.source.counts(span)

    def __enter__(self) -> FailsToRead:
        return self

    def __exit__(self, *_: Any) -> None:
        self.source.close()


class NoConfig(Config):
    pass


def cannot_be_built(*_: Any) -> Any:
    raise RuntimeError("the cable came loose")


UNBUILT = "could not be built: RuntimeError: the cable came loose"
FAILED = "failed at level 1: RuntimeError: the cable came loose"
BROKEN = (
    "broke its contract at level 1: a homography is a finite (3, 3) matrix with h33 = 1, "
    "got [[nan, nan, nan], [nan, nan, nan], [nan, nan, nan]]; a failure is NotLocated"
)
STILL = (
    "broke its contract at level 1: every pair that was located is exactly the identity, which a camera that stands still "
    "does not give; a failure is NotLocated"
)
LATER = "broke its contract at level 1: a homography is finite with h33 = 1, that of frame 0 is {}"
CASES: dict[str, tuple[str, type, Callable[..., Any], str]] = {
    "build source": ("source", SourceContribution, cannot_be_built, UNBUILT),
    "build merger": ("merge", MergerContribution, cannot_be_built, UNBUILT),
    "groups": ("resample", ResamplerContribution, lambda *_: Fragile(), FAILED),
    "merge": ("merge", MergerContribution, lambda *_: Fragile(), FAILED),
    "describe": ("locate", LocatorContribution, lambda *_: Fragile(), FAILED),
    "register": ("locate", LocatorContribution, lambda *_: FailsToRegister(), FAILED),
    "register, NaN": ("locate", LocatorContribution, lambda *_: FindsNonsense(), BROKEN),
    "register, identity": ("locate", LocatorContribution, lambda *_: FindsNothingMoved(1), STILL),
    "groups, none": (
        "resample",
        ResamplerContribution,
        lambda *_: GivesNoGroups(),
        "broke its contract at level 1: expected groups, got (0, 300)",
    ),
    "merge, no exposure": (
        "merge",
        MergerContribution,
        lambda *_: GivesNoExposure(),
        "broke its contract at level 1: expected a VirtualExposure, got ndarray",
    ),
    "trajectory": ("interpolate", InterpolatorContribution, lambda *_: FailsLater(Fragile().fails), FAILED),
    "trajectory, NaN": (
        "interpolate",
        InterpolatorContribution,
        lambda *_: FailsLater(lambda frames: np.full((len(frames), 3, 3), np.nan)),
        LATER.format("[[nan, nan, nan], [nan, nan, nan], [nan, nan, nan]]"),
    ),
    "trajectory, shape": (
        "interpolate",
        InterpolatorContribution,
        lambda *_: FailsLater(lambda _: np.eye(3), good_for=0),
        "broke its contract at level 1: expected homographies of the shape (11, 3, 3), got (3, 3)",
    ),
    "fit": ("interpolate", InterpolatorContribution, lambda *_: Fragile(), FAILED),
}


def failure(spec: dict[str, Any], contribution: Any, folder: Path) -> str:
    """Run a spec with a failing plugin, require that the run folder is unchanged, and return the message."""
    entry = make_entry(contribution, Origin("strange-plugin", "1.2", "strange = strange.hooks"))
    catalog = Catalog((*discover().rows, entry))
    (folder / "panorama.png").write_text("of an earlier run")
    with pytest.raises(PluginError) as caught:
        run(parse_spec(spec, output=folder, catalog=catalog), overwrite=True)
    assert [(file.name, file.read_text()) for file in folder.iterdir()] == [("panorama.png", "of an earlier run")]
    return str(caught.value)


@pytest.mark.parametrize(("section", "kind", "build", "message"), CASES.values(), ids=CASES)
def test_run_names_failing_plugin_and_keeps_run_folder(
    small_spec: dict[str, Any], tmp_path: Path, section: str, kind: Any, build: Callable[..., Any], message: str
) -> None:
    contribution = kind(name="fragile", summary="Fails", config=NoConfig, build=build)
    spec = small_spec | {section: {"use": "fragile"}, "levels": 1}
    assert failure(spec, contribution, tmp_path) == f"{contribution.kind} 'fragile' of strange-plugin 1.2 {message}"


@pytest.mark.parametrize(
    ("fails", "answer", "message"),
    [
        (bool, Fragile.fails, "failed at frames 0 to 15: RuntimeError: the cable came loose"),
        (lambda span: len(span) > 16, Fragile.fails, "failed at frames 0 to 49: RuntimeError: the cable came loose"),
        (lambda span: span.start > 289, Fragile.fails, "failed at frames 290 to 293: RuntimeError: the cable came loose"),
        (
            bool,
            lambda *_: np.zeros(4, np.uint32),
            "broke its contract at frames 0 to 15: expected the shape (128, 160), got (4,)",
        ),
    ],
    ids=["at first", "while merging", "while rendering", "shape"],
)
def test_failing_source_is_named_in_every_stage(
    small_spec: dict[str, Any], tmp_path: Path, fails: Callable[..., bool], answer: Callable[..., Any], message: str
) -> None:
    """The message names the source, not the merger that called it."""
    installed = discover()
    opened = installed.find("source", "packed-npy").contribution

    def build(config: Any, context: Any) -> Any:
        return FailsToRead(opened.build(config, context), fails, answer)

    fragile = SourceContribution(name="fragile", summary="Fails", config=opened.config, build=build)
    source = {"use": "fragile", "with": small_spec["source"]["with"]}
    spec = small_spec | {"source": source, "corrections": [], "levels": 1}
    assert failure(spec, fragile, tmp_path) == f"source 'fragile' of strange-plugin 1.2 {message}"


def test_locator_that_returns_identity_for_moving_frames_is_named(small_spec: dict[str, Any], tmp_path: Path) -> None:
    """Level 1 succeeds, so the motion is known at level 2: a pan of 5 px from one group to the next."""
    direct = discover().find("locator", "direct").contribution

    def build(config: Any, context: Any) -> Any:
        return FindsNothingMoved(2, direct.build(config, context))

    fragile = LocatorContribution(name="fragile", summary="Fails", config=direct.config, build=build)
    spec = small_spec | {"locate": {"use": "fragile"}, "levels": 2}
    message = failure(spec, fragile, tmp_path)
    assert re.fullmatch(
        r"locator 'fragile' of strange-plugin 1\.2 broke its contract at level 2: got the identity where the motion known so "
        r"far moves the corners by 1\d px; a failure is NotLocated",
        message,
    )


def test_record_converts_numpy_and_non_finite_numbers(small_spec: dict[str, Any], tmp_path: Path) -> None:
    """A locator that loses pairs, with evidence of numpy types."""
    direct = discover().find("locator", "direct").contribution

    class Counts:
        def __init__(self, locator: Any) -> None:
            self.describe, self.locator, self.calls = locator.describe, locator, 0

        def register(self, moving: Any, fixed: Any, initial: Any) -> Any:
            self.calls += 1
            if self.calls > 1:
                return self.locator.register(moving, fixed, initial)
            return NotLocated("shy", {"matches": np.int64(7), "score": np.float32(0.5), "ncc": np.nan, "found": np.True_})

    shy = LocatorContribution(
        name="shy", summary="Shy", config=direct.config, build=lambda *given: Counts(direct.build(*given))
    )
    plan = parse_spec(
        small_spec | {"locate": {"use": "shy"}, "levels": 1}, output=tmp_path / "run", catalog=discover().including(shy)
    )
    run(plan)
    (lost,) = json.loads((tmp_path / "run" / "run.json").read_text())["levels"][0]["failures"]
    assert lost["evidence"] == {"matches": 7, "score": 0.5, "ncc": None, "found": True}
