"""What the library does to the process that it is loaded into."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import pytest

pytest.importorskip("pycolmap")

LIBRARIES = [name for name in ("torch", "cv2", "pycolmap") if importlib.util.find_spec(name)]
REGISTER = """
import numpy as np
from photonpano import FrameSpan, Group, VirtualExposure
from photonpano.photometry import BinaryResponse
from photonpano_colmap.configs import PycolmapTwoViewConfig
from photonpano_colmap.two_view import TwoViewLocator

flux = np.random.default_rng(0).random((12, 16), np.float32).repeat(8, axis=0).repeat(8, axis=1)
exposure = VirtualExposure(flux, np.full(flux.shape, 250, np.float32), Group(FrameSpan(0, 250), 0), 1.0, BinaryResponse())
locator = TwoViewLocator(PycolmapTwoViewConfig(), 0)
features = locator.describe(exposure)
print(type(locator.register(features, features, np.eye(3))).__name__)
"""


@pytest.mark.parametrize("order", [LIBRARIES, LIBRARIES[::-1]], ids=" ".join)
def test_libraries_can_be_imported_in_any_order_without_stderr(order: list[str]) -> None:
    """An order and its reverse include each pair of libraries in both orders."""
    code = "".join(f"import {name}\n" for name in order) + REGISTER
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "Located\n", "")
