"""A source and a merger written before there was a `Capture`: unchanged, they pass the kit and run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import (
    Config,
    FrameSpan,
    Group,
    LensedSource,
    LinearlyCorrectedSource,
    LitSource,
    MergerContribution,
    Source,
    SourceContribution,
    StreamInfo,
    Trajectory,
    VirtualExposure,
    WeightedSource,
    discover,
    parse_spec,
    run,
)
from photonpano.geometry import translation
from photonpano.photometry import BinaryResponse
from photonpano.testing import KnownMotion, MergerConformance, Scene, SourceConformance
from photonpano.testing.captures import recorded

DARK_RATE = 0.02
FRAMES = recorded(Scene(), KnownMotion(lambda frame: translation(0.15 * frame, 0.05 * frame)), 160, (48, 64))


class NoKeys(Config):
    """Nothing to choose."""


class OldSource:
    """Packs its frames, and subtracts dark counts from their sums."""

    def __init__(self) -> None:
        self.info = StreamInfo(*FRAMES.shape, frame_rate_hz=None)
        self.response, self.valid = BinaryResponse(), np.ones(FRAMES.shape[1:], np.bool_)

    def counts(self, span: FrameSpan) -> np.ndarray:
        return self.frames(span).sum(axis=0, dtype=np.uint32)

    def frames(self, span: FrameSpan) -> np.ndarray:
        self.info.require(span)
        return FRAMES[span.start : span.stop].copy()

    def packed(self, span: FrameSpan) -> np.ndarray:
        return np.packbits(self.frames(span), axis=-1)

    def corrected(self, counts: np.ndarray, n_frames: int) -> np.ndarray:
        return np.float32(n_frames) - (np.float32(n_frames) - counts.astype(np.float32)) * np.float32(np.exp(DARK_RATE))

    def close(self) -> None: ...

    def __enter__(self) -> OldSource:
        return self

    def __exit__(self, *error: object) -> None: ...


class OldMerger:
    """Sums the frames of a group as they are, and asks the source for what it knows."""

    def merge(self, source: Source, group: Group, trajectory: Trajectory | None, scale: float) -> VirtualExposure:
        counts: Any = source.counts(group.span)
        n_frames, frames = len(group.span), np.where(source.valid, np.float32(len(group.span)), 0)
        if isinstance(source, LinearlyCorrectedSource):
            counts = source.corrected(counts, n_frames)
        if isinstance(source, WeightedSource):
            frames = frames * source.weights()
        if isinstance(source, LitSource):
            frames = frames * source.light.mean(group.span)
        assert not isinstance(source, LensedSource)
        mean = np.asarray(np.maximum(counts, 0) / n_frames, np.float32)
        flux = np.where(frames > 0, source.response.flux(mean, n_frames), np.float32(np.nan))
        return VirtualExposure(flux, np.asarray(frames, np.float32), group, scale, source.response)


SOURCE = SourceContribution(name="old", summary="Toy", config=NoKeys, build=lambda *_: OldSource())
MERGER = MergerContribution(name="old-merger", summary="Toy", config=NoKeys, build=lambda *_: OldMerger())


class TestOldSource(SourceConformance):
    heavy = frozenset()
    contribution = SOURCE


class TestOldMerger(MergerConformance):
    heavy = frozenset()
    contribution = MERGER
    scales = (1.0,)
    compensates = False


@pytest.mark.parametrize("light", ["auto", "changing"])
def test_old_plugins_run_unchanged(light: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: set[tuple[bool, ...]] = set()
    merge: Callable[..., VirtualExposure] = OldMerger.merge

    def asking(self: OldMerger, source: Source, *given: Any) -> VirtualExposure:
        asked.add(tuple(isinstance(source, each) for each in (LinearlyCorrectedSource, WeightedSource, LitSource)))
        return merge(self, source, *given)

    monkeypatch.setattr(OldMerger, "merge", asking)
    spec = {
        "version": 1,
        "source": {"use": "old"},
        "resample": {"use": "midpoint", "with": {"group_size": 20}},
        "merge": {"use": "old-merger"},
        "levels": 1,
        "light": light,
    }
    done = run(parse_spec(spec, output=tmp_path / "run", catalog=discover().including(SOURCE).including(MERGER)))
    with np.load(done.directory / "trajectory.npz") as trajectory:
        shifts = trajectory["homographies"][:, :2, 2]
    assert np.abs(shifts[140] - shifts[20] - [18, 6]).max() < 3  # its exposures are blurred by 3 px
    assert asked == {(True, False, False), *([(True, False, True)] if light == "changing" else [])}
