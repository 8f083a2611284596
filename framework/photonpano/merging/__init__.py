"""Sums of frames along a motion: frames are summed in chunks, and each chunk is warped once."""

from .accumulate import PhotonSum as PhotonSum
from .accumulate import accumulate as accumulate
from .accumulate import binned_mean as binned_mean
from .accumulate import binning_of as binning_of
from .accumulate import divided as divided
from .chunks import Chunk as Chunk
from .chunks import CountsCache as CountsCache
from .chunks import chunks_of as chunks_of
from .chunks import clipped as clipped
from .light import LightTerms as LightTerms
from .light import LitFrames as LitFrames
from .light import gain_image as gain_image
from .panorama import MergeRenderer as MergeRenderer
