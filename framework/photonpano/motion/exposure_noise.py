"""The noise of exposures: all pairs of an exposure share it, and exposures with frames in common share more of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photonpano.values import BoolArray, FloatArray, FrameSpan

# Least weight of a pair. Shared photons carry no new information: their noise agrees with the motion known so far.
_LEAST_WEIGHT = 0.05
_LEAST = 1e-9  # eigenvalue of the information of an exposure, relative to its largest


@dataclass(frozen=True, slots=True, eq=False)
class ExposureNoise:
    """How the exposures of a graph share the noise of their photons.

    A pair errs by the noise of its two exposures, and by what it adds since it sees only the part of the scene that both show.
    """

    pairs: NDArray[np.integer]  # (E, 2) the moving and the fixed exposure of each pair
    # (N, C) shares of N exposures in the noise of C spans of frames, between whose ends no exposure begins or ends; their
    # squares add up to 1
    shares: FloatArray
    # (E,) weights with which pairs count the photons of each exposure once, however many of them it is in, and however many
    # exposures hold its frames
    weights: FloatArray
    shown: BoolArray  # (E,) False for pairs that no exposures show: each errs by itself

    @classmethod
    def of(cls, pairs: NDArray[np.integer], spans: Sequence[FrameSpan], shown: BoolArray | None = None) -> ExposureNoise:
        """Compute what N exposures share from the frames of each; without `shown`, exposures show all pairs."""
        shown = np.ones(len(pairs), dtype=bool) if shown is None else shown
        bounds = np.array([(span.start, span.stop) for span in spans], dtype=np.float64)
        ends = np.unique(bounds)
        inside = (bounds[:, :1] <= ends[:-1]) & (ends[1:] <= bounds[:, 1:])
        shares = np.sqrt(inside * np.diff(ends))
        shares /= np.linalg.norm(shares, axis=1, keepdims=True)
        (starts, stops), (moving, fixed) = bounds.T, pairs.T
        common = np.minimum(stops[moving], stops[fixed]) - np.maximum(starts[moving], starts[fixed])
        shared = np.maximum(common, 0) / np.minimum((stops - starts)[moving], (stops - starts)[fixed])
        # The correlations of each exposure with all others, at low frequencies of the motion, add up.
        repeated = shares @ shares.sum(axis=0)
        degrees = np.bincount(pairs[shown].ravel(), minlength=len(spans))
        counted = (degrees[moving] + degrees[fixed]) / 4 * np.sqrt(repeated[moving] * repeated[fixed])
        weights = np.where(shown, np.maximum(1 - shared, _LEAST_WEIGHT) / np.maximum(counted, 1), 1.0)
        return cls(pairs, shares, weights, shown)

    def errors(self, moving: FloatArray, fixed: FloatArray, n_draws: int, rng: np.random.Generator) -> FloatArray:
        """Draw errors of pairs, in units in which their covariance is the identity if they share nothing: (E, 8, n_draws).

        `moving` and `fixed` are the derivatives of the residuals of each pair, in these units, by small motions of its frames:
        (E, 8, 8).
        """
        moving, fixed = (np.where(self.shown[:, None, None], slopes, 0) for slopes in (moving, fixed))
        roots = self._roots(moving, fixed)
        chunks = rng.normal(size=(self.shares.shape[1], 8 * n_draws))
        noise = roots @ (self.shares @ chunks).reshape(len(roots), 8, n_draws)
        known = [slopes @ roots[nodes] for slopes, nodes in ((moving, self.pairs[:, 0]), (fixed, self.pairs[:, 1]))]
        beside = np.eye(8) - sum(each @ np.swapaxes(each, 1, 2) for each in known)
        values, vectors = np.linalg.eigh(beside)
        own = (vectors * np.sqrt(np.maximum(values, 0))[:, None]) @ rng.normal(size=(len(moving), 8, n_draws))
        return np.asarray(moving @ noise[self.pairs[:, 0]] + fixed @ noise[self.pairs[:, 1]] + own)

    def _roots(self, moving: FloatArray, fixed: FloatArray) -> FloatArray:
        """Return roots of the covariances of the noise of the exposures: (N, 8, 8).

        Half of the variance of a pair comes from each exposure. An exposure knows its motion at least as well as any of its
        pairs shows it, in each direction.
        """
        nodes = np.concatenate([self.pairs[:, 0], self.pairs[:, 1]])
        slopes = np.concatenate([moving, fixed])
        of_pairs = 2 * np.swapaxes(slopes, 1, 2) @ slopes
        order = np.lexsort([-np.trace(of_pairs, axis1=1, axis2=2), nodes])
        rank = np.arange(len(nodes)) - np.searchsorted(nodes[order], nodes[order])
        information = np.broadcast_to(np.finfo(float).tiny * np.eye(8), (len(self.shares), 8, 8)).copy()
        information[nodes[order[rank == 0]]] = of_pairs[order[rank == 0]]
        for number in range(1, int(rank.max(initial=0)) + 1):
            here = order[rank == number]
            root, back = _roots(information[nodes[here]])
            values, vectors = np.linalg.eigh(back @ of_pairs[here] @ back)
            more = root @ vectors
            information[nodes[here]] += (more * np.maximum(values - 1, 0)[:, None]) @ np.swapaxes(more, 1, 2)
        return _roots(information)[1]


def _roots(information: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the symmetric roots of (N, 8, 8) information, and of its inverse."""
    values, vectors = np.linalg.eigh(information)
    roots = np.sqrt(np.maximum(values, np.maximum(_LEAST * values[:, -1:], np.finfo(float).tiny)))
    back = np.swapaxes(vectors, 1, 2)
    return (vectors * roots[:, None]) @ back, (vectors / roots[:, None]) @ back
