"""Small captures and motions that many tests need: in memory, without plugins; and simulated, for whole runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from photonpano.geometry import translation
from photonpano.testing import KnownMotion, MemorySource

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from photonpano.api import RunResult


@pytest.fixture(scope="session")
def memory_source() -> type[MemorySource]:
    return MemorySource


@pytest.fixture(scope="session")
def known_motion() -> type[KnownMotion]:
    return KnownMotion


@pytest.fixture(scope="session")
def pan() -> Callable[..., KnownMotion]:
    """Make a motion of so many pixels a frame."""

    def make(x_px: float, y_px: float = 0.0) -> KnownMotion:
        return KnownMotion(lambda frame: translation(x_px * frame, y_px * frame))

    return make


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Write a small capture and its truth: 300 frames of 128x160 px of a street, on a pan of 60 px with a trembling hand."""
    from photonpano.pipeline.capture import write_packed
    from photonpano.pipeline.components import build_source
    from photonpano.spec import parse_spec

    def simulated(**changes: Any) -> Path:
        shake = {"rms_px": 3, "frequencies_hz": [300, 400, 600]}
        settings = {
            "scene": {"kind": "street", "width": 1024, "height": 682},
            "path": {"kind": "pan", "length_px": 60, "angle_deg": 10, "shake": shake},
            "n_frames": 300,
            "frame_shape": [128, 160],
        }
        spec = {"version": 1, "source": {"use": "simulator", "with": settings | changes}}
        path = tmp_path_factory.mktemp("capture") / "cube.npy"
        with build_source(parse_spec(spec)) as source:
            write_packed(source, path)
        return path

    return simulated


@pytest.fixture(scope="session")
def small_capture(simulated: Callable[..., Path]) -> Path:
    return simulated()


@pytest.fixture(scope="session")
def small_spec(small_capture: Path) -> dict[str, Any]:
    """A spec of the small capture with groups of 50 frames; three levels as by default."""
    return {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(small_capture), "frame_rate_hz": 96800}},
        "resample": {"use": "midpoint", "with": {"group_size": 50}},
    }


@pytest.fixture(scope="session")
def small_run(small_spec: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A whole run of the small capture. Tests read its folder and leave it as it is."""
    from photonpano import api
    from photonpano.spec import parse_spec

    return api.run(parse_spec(small_spec, output=tmp_path_factory.mktemp("runs") / "small"))
