"""Camera responses and flux estimation, similarity of images, tone curves, and sums of packed bits."""

from photonpano.photometry.noise import FluxRange, debiased, flux_std, frame_variance, measurable_range, saturated
from photonpano.photometry.packed import MAX_FRAMES, BitOrder, packed_along_width, packed_counts, reversed_bits
from photonpano.photometry.pictures import (
    Tone,
    WhiteBalance,
    balanced,
    grey_world,
    linear_to_srgb,
    picture_of,
    srgb_to_linear,
    tone_mapped,
)
from photonpano.photometry.responses import BinaryResponse, BinarySumResponse, Factor, IntensityResponse
from photonpano.photometry.similarity import (
    LOCAL_PX,
    Similarity,
    autocorrelation,
    hann_window,
    noise_free_correlation,
    signal_to_noise,
    similarity_of,
    tapered,
    without_local_mean,
)

__all__ = [
    "LOCAL_PX",
    "MAX_FRAMES",
    "BinaryResponse",
    "BinarySumResponse",
    "BitOrder",
    "Factor",
    "FluxRange",
    "IntensityResponse",
    "Similarity",
    "Tone",
    "WhiteBalance",
    "autocorrelation",
    "balanced",
    "debiased",
    "flux_std",
    "frame_variance",
    "grey_world",
    "hann_window",
    "linear_to_srgb",
    "measurable_range",
    "noise_free_correlation",
    "packed_along_width",
    "packed_counts",
    "picture_of",
    "reversed_bits",
    "saturated",
    "signal_to_noise",
    "similarity_of",
    "srgb_to_linear",
    "tapered",
    "tone_mapped",
    "without_local_mean",
]
