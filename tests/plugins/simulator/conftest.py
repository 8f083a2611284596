from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from photonpano import SourceContext
from photonpano_simulator.config import SimulatorConfig
from photonpano_simulator.source import SimulatorSource


@pytest.fixture(scope="session")
def photo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grey photograph of 200x150 px with smooth texture."""
    grey = cv2.GaussianBlur(np.random.default_rng(0).uniform(0, 255, (150, 200)), (0, 0), 3)
    path = tmp_path_factory.mktemp("scenes") / "photo.png"
    cv2.imwrite(str(path), cv2.normalize(grey, None, 10, 250, cv2.NORM_MINMAX).astype(np.uint8))
    return path


@pytest.fixture
def simulated(photo: Path) -> Callable[..., SimulatorSource]:
    """Build the simulator on the small photograph, with other settings as given."""

    def build(run_seed: int = 0, **settings: Any) -> SimulatorSource:
        small = {
            "scene": {"kind": "photo", "file": photo},
            "path": {"kind": "pan", "length_px": 60},
            "n_frames": 50,
            "frame_shape": (40, 52),
        }
        return SimulatorSource(SimulatorConfig.model_validate(small | settings), SourceContext(seed=run_seed))

    return build
