"""Where patches of a template lie in the other image, beyond the homography that aligns them: one step for each patch."""

from __future__ import annotations

import numpy as np

from photonpano import FloatArray, Homography, Patches
from photonpano.compiling import compiled
from photonpano.geometry import PATCHES, patch_centres, transform_points
from photonpano_direct.moments import Buffers, Layer

_LEAST_SEEN = 0.5  # share of a patch that both images must see
_TEXTURE = 0.02  # least curvature along a direction, relative to the patch's, that counts as texture
_LARGEST_PX = 2.0  # step, in px of the layer, beyond which the image is not linear in it
_SUMS = 9


def sums_of_patches(template: Layer, buffers: Buffers) -> FloatArray:
    """Return the (P, 9) sums of `add_up` over the patches of a template; residual and weight are those of its last step."""
    sums = np.zeros((PATCHES, PATCHES, _SUMS))
    add_up(template, buffers, sums)
    return sums.reshape(-1, _SUMS)


def patches_of(sums: FloatArray, homography: Homography, shape: tuple[int, int], common: float, noise_ratio: float) -> Patches:
    """Return where the patches of an aligned template lie, in pixels of its layer.

    Args:
        sums: (P, 9) those of `sums_of_patches`.
        homography: (3, 3) from the template to the other layer.
        shape: (height, width) of the layer.
        common: share of the curvature of the template that the scene has, not its noise.
        noise_ratio: mean squared residual relative to that of photon noise.
    """
    own, scatter = (sums[:, [xx, xx + 1, xx + 1, xx + 2]].reshape(-1, 2, 2) for xx in (0, 5))
    # Noise has the same curvature along all directions, and in all patches alike.
    seen, traces = sums[:, 8], np.trace(own, axis1=1, axis2=2)
    noise = (1 - common) * traces.sum() / max(seen.sum(), 1) * seen / 2
    values, vectors = np.linalg.eigh(own - noise[:, None, None] * np.eye(2))
    values = np.maximum(values, _TEXTURE * np.maximum(traces, 1e-9)[:, None])
    hessian = vectors @ (values[..., None] * np.swapaxes(vectors, -1, -2))
    steps = np.linalg.solve(hessian, sums[:, 3:5, None])[..., 0]
    # As for the whole template, the blur correlates the noise of neighbours: the step scatters by H^-1 M H^-1.
    information = hessian @ np.linalg.pinv(scatter, hermitian=True) @ hessian / max(1.0, noise_ratio)
    usable = (seen >= _LEAST_SEEN * shape[0] * shape[1] / len(sums)) & (np.linalg.norm(steps, axis=1) < _LARGEST_PX)

    # A patch that is seen at x + step of the template is where the homography maps x; so its middle lies a step before.
    middles = patch_centres(shape)
    there = transform_points(homography, middles)
    shifts = transform_points(homography, middles - steps) - there
    depth = middles @ homography[2, :2] + homography[2, 2]
    to_template = np.linalg.inv((homography[:2, :2] - there[..., None] * homography[2, :2]) / depth[:, None, None])
    information = np.swapaxes(to_template, -1, -2) @ information @ to_template
    kept = usable[:, None]
    return Patches(np.where(kept, shifts, 0.0), np.where(kept[..., None], information, 0.0))


@compiled
def add_up(template: Layer, buffers: Buffers, sums: FloatArray) -> None:
    """Add up (rows, columns, 9) sums over the pixels of each patch, with the gradient g, residual r and weight w of a pixel.

    They are w times the products xx, xy, yy of g; w r g; w^2 times the products of the smoothed g, relative to the mean weight;
    and the number of pixels that both images see.
    """
    height, width = template.image.shape
    rows, columns, _ = sums.shape
    total, count = 0.0, 0
    for y in range(height):
        row = y * rows // height
        residual, weight = buffers.residual[y], buffers.weight[y]
        gx, gy, sx, sy = template.gradients[0][y], template.gradients[1][y], template.smoothed[0][y], template.smoothed[1][y]
        for column in range(columns):
            part = sums[row, column]
            first, last = -(-column * width // columns), -(-(column + 1) * width // columns)
            for x in range(first, last):
                w = weight[x]
                if w > 0:
                    wx, wy = w * gx[x], w * gy[x]
                    part[0] += wx * gx[x]
                    part[1] += wx * gy[x]
                    part[2] += wy * gy[x]
                    part[3] += wx * residual[x]
                    part[4] += wy * residual[x]
                    w2 = w * w
                    part[5] += w2 * sx[x] * sx[x]
                    part[6] += w2 * sx[x] * sy[x]
                    part[7] += w2 * sy[x] * sy[x]
                    part[8] += 1
                    total += w
                    count += 1
    sums[:, :, 5:8] *= count / max(total, 1e-20)
