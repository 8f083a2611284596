"""The motion graph of homographies: eight unknowns a node."""

from __future__ import annotations

import numpy as np

from photonpano.geometry import from_parameters, generators, normalised, parameters, unit_coordinates
from photonpano.motion.adjustment import Adjustment
from photonpano.values import FloatArray


class HomographyAdjustment(Adjustment[FloatArray]):
    """The least-squares problem of a graph whose nodes have any homographies; its state is these, (N, 3, 3) with h33 = 1.

    The unknowns of a node are p1..p8 of a small homography of its own frame, in coordinates of about unit size.
    """

    _n_node = 8

    def homographies(self, state: FloatArray) -> FloatArray:
        """Return the state."""
        return state

    def changed(self, state: FloatArray, nodes: FloatArray, shared: FloatArray) -> FloatArray:
        """Return the homographies after a step; nothing is shared."""
        del shared
        unit = unit_coordinates(self._frame_shape)
        return normalised(state @ (np.linalg.inv(unit) @ from_parameters(nodes) @ unit))

    def anchored(self, state: FloatArray) -> FloatArray:
        """Return the homographies, of which the anchor's is the identity."""
        state[self._anchor] = np.eye(3)
        return state

    def generators(self, state: FloatArray) -> FloatArray:
        """Return those of p1..p8 in unit coordinates: (8, 3, 3)."""
        del state
        return generators(self._frame_shape)

    def information(self, state: FloatArray, blocks: FloatArray) -> FloatArray:
        """Convert (N, 8, 8) information on changes of nodes to that on p1..p8 of their homographies."""
        changed = state[:, None] @ generators(self._frame_shape)
        slopes = changed - state[:, None] * changed[..., 2:, 2:]
        to_parameters = parameters(np.eye(3) + slopes).transpose(0, 2, 1)
        to_change = np.linalg.inv(to_parameters)
        return np.asarray(to_change.transpose(0, 2, 1) @ blocks @ to_change)
