"""Names for the arrays that stages exchange: geometry is float64, flux is float32."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
"""Any float64 array: coordinates, parameters, covariances."""

Homography: TypeAlias = NDArray[np.float64]
"""(3, 3) float64 with h33 = 1; (N, 3, 3) where stated."""

FluxImage: TypeAlias = NDArray[np.float32]
"""(H, W) float32: photons per pixel per frame, NaN where unknown; (H, W, 3) where stated."""

Counts: TypeAlias = NDArray[np.uint32]
"""(H, W) uint32: sums of frames."""

Frames: TypeAlias = NDArray[np.uint8] | NDArray[np.uint16]
"""(n, H, W): zeros and ones of a binary capture, grey values or small sums of another."""

BoolArray: TypeAlias = NDArray[np.bool_]
