"""Sums of frames along a motion: frames are summed in chunks, and each chunk is warped once."""

from .accumulate import Chunk as Chunk
from .accumulate import CountsCache as CountsCache
from .accumulate import LightTerms as LightTerms
from .accumulate import LitFrames as LitFrames
from .accumulate import PhotonSum as PhotonSum
from .accumulate import accumulate as accumulate
from .accumulate import binned_mean as binned_mean
from .accumulate import binning_of as binning_of
from .accumulate import chunks_of as chunks_of
from .accumulate import clipped as clipped
from .accumulate import divided as divided
from .accumulate import gain_image as gain_image
from .panorama import MergeRenderer as MergeRenderer
