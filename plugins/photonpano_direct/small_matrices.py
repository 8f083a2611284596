"""Products, inverses and roots of small matrices, as loops: those of numpy take a compiler ten times as long to translate."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photonpano.compiling import compiled


@compiled
def product(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the product of (n, k) and (k, m) matrices."""
    result = np.zeros((first.shape[0], second.shape[1]))
    for i in range(first.shape[0]):
        for k in range(first.shape[1]):
            for j in range(second.shape[1]):
                result[i, j] += first[i, k] * second[k, j]
    return result


@compiled
def dot(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    """Return the scalar product of two (k,) vectors."""
    total = 0.0
    for k in range(len(first)):
        total += first[k] * second[k]
    return total


@compiled
def transposed(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the transpose of a matrix, in the order of memory that is usual."""
    result = np.empty((matrix.shape[1], matrix.shape[0]))
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            result[j, i] = matrix[i, j]
    return result


@compiled
def applied(matrix: NDArray[np.float64], vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the product of an (n, k) matrix and a (k,) vector."""
    result = np.empty(matrix.shape[0])
    for i in range(matrix.shape[0]):
        result[i] = dot(matrix[i], vector)
    return result


@compiled
def inverse_homography(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a (3, 3) matrix, up to scale: its adjugate."""
    result = np.empty((3, 3))
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            result[j, i] = matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]
    return result


@compiled
def rescaled(homography: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Return the same motion between images that are both rescaled; what `photonpano.geometry.rescaled` does, for one."""
    offset = 0.5 * scale - 0.5
    there = np.array([[scale, 0.0, offset], [0.0, scale, offset], [0.0, 0.0, 1.0]])
    back = np.array([[1 / scale, 0.0, -offset / scale], [0.0, 1 / scale, -offset / scale], [0.0, 0.0, 1.0]])
    return scaled_to_one(product(product(there, homography), back))


@compiled
def scaled_to_one(homography: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a homography with h33 = 1."""
    result = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            result[i, j] = homography[i, j] / homography[2, 2]
    return result


@compiled
def cholesky(matrix: NDArray[np.float64], root: NDArray[np.float64]) -> bool:
    """Write the lower root of a matrix into zeros; tell whether it is positive definite."""
    for i in range(len(matrix)):
        for j in range(i + 1):
            left = matrix[i, j]
            for k in range(j):
                left -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = left / root[j, j]
            elif left > 0:
                root[i, i] = np.sqrt(left)
            else:
                return False
    return True


@compiled
def solve_lower(root: NDArray[np.float64], right: NDArray[np.float64]) -> None:
    """Replace the right side of R x = right by its solution, for a lower triangular R; right is (n, m)."""
    for i in range(len(root)):
        for j in range(right.shape[1]):
            left = right[i, j]
            for k in range(i):
                left -= root[i, k] * right[k, j]
            right[i, j] = left / root[i, i]


@compiled
def solve(matrix: NDArray[np.float64], right: NDArray[np.float64]) -> bool:
    """Replace the right side of linear equations, (n, 1), by their solution; tell whether the matrix is positive definite."""
    n = len(right)
    root = np.zeros((n, n))
    if not cholesky(matrix, root):
        return False
    solve_lower(root, right)
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i, 0] -= root[k, i] * right[k, 0]
        right[i, 0] /= root[i, i]
    return True
