"""Sums of frames along a motion: chunks of frames that stand still, one warp a chunk, one estimate of all counts."""

from photonpano.merging.accumulate import PhotonSum, accumulate
from photonpano.merging.chunks import Chunk, chunks_of

__all__ = ["Chunk", "PhotonSum", "accumulate", "chunks_of"]
