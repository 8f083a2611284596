"""Sums of frames along a motion: frames are summed in chunks, and each chunk is warped once."""

from photonpano.merging.accumulate import PhotonSum, accumulate, divided
from photonpano.merging.binning import binned_mean, binning_of
from photonpano.merging.chunks import Chunk, CountsCache, chunks_of, clipped
from photonpano.merging.light import LightTerms, LitFrames, gain_image
from photonpano.merging.panorama import MergeRenderer

__all__ = [
    "Chunk",
    "CountsCache",
    "LightTerms",
    "LitFrames",
    "MergeRenderer",
    "PhotonSum",
    "accumulate",
    "binned_mean",
    "binning_of",
    "chunks_of",
    "clipped",
    "divided",
    "gain_image",
]
