"""Linear algebra of small matrices as loops, which numba compiles ten times as fast as calls of numpy."""

from __future__ import annotations

import numpy as np

from photonpano import FloatArray
from photonpano.compiling import compiled


@compiled
def product(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the product of (n, k) and (k, m) matrices."""
    result = np.zeros((first.shape[0], second.shape[1]))
    for i in range(first.shape[0]):
        for k in range(first.shape[1]):
            for j in range(second.shape[1]):
                result[i, j] += first[i, k] * second[k, j]
    return result


@compiled
def dot(first: FloatArray, second: FloatArray) -> float:
    """Return the scalar product of two (k,) vectors."""
    total = 0.0
    for k in range(len(first)):
        total += first[k] * second[k]
    return total


@compiled
def transposed(matrix: FloatArray) -> FloatArray:
    """Return the transpose of a matrix as a C-contiguous copy."""
    result = np.empty((matrix.shape[1], matrix.shape[0]))
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            result[j, i] = matrix[i, j]
    return result


@compiled
def applied(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Return the product of an (n, k) matrix and a (k,) vector."""
    result = np.empty(matrix.shape[0])
    for i in range(matrix.shape[0]):
        result[i] = dot(matrix[i], vector)
    return result


@compiled
def inverse_homography(matrix: FloatArray) -> FloatArray:
    """Return the inverse of a (3, 3) matrix, up to scale: its adjugate."""
    result = np.empty((3, 3))
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            result[j, i] = matrix[a, c] * matrix[b, d] - matrix[a, d] * matrix[b, c]
    return result


@compiled
def scaled_to_one(homography: FloatArray) -> FloatArray:
    """Return a homography with h33 = 1."""
    result = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            result[i, j] = homography[i, j] / homography[2, 2]
    return result


@compiled
def cholesky(matrix: FloatArray, root: FloatArray) -> bool:
    """Write the lower Cholesky factor into `root`, which holds zeros; return whether the matrix is positive definite."""
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
def solve_lower(root: FloatArray, right: FloatArray) -> None:
    """Solve R x = right in place, for a lower triangular R and (n, m) right sides."""
    for i in range(len(root)):
        for j in range(right.shape[1]):
            left = right[i, j]
            for k in range(i):
                left -= root[i, k] * right[k, j]
            right[i, j] = left / root[i, i]


@compiled
def solve(matrix: FloatArray, right: FloatArray) -> bool:
    """Solve linear equations with an (n, 1) right side in place; return whether the matrix is positive definite."""
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
