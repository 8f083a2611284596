"""The detection model, flux estimation and tone curves."""

from photonpano.photometry.responses import BinaryResponse
from photonpano.photometry.tone import linear_to_srgb, srgb_to_linear, tone_mapped

__all__ = ["BinaryResponse", "linear_to_srgb", "srgb_to_linear", "tone_mapped"]
