"""Sums of frames along a motion: chunks of frames that stand still, one warp a chunk, one estimate of all counts."""

from photonpano.merging.accumulate import PhotonSum, accumulate
from photonpano.merging.chunks import Chunk, chunks_of, clipped
from photonpano.merging.sharing import SharedCounts

__all__ = ["Chunk", "PhotonSum", "SharedCounts", "accumulate", "chunks_of", "clipped"]
