"""photonpano: sharp panoramas from single-photon cameras.

The names here are public: plugins and notebooks import them from `photonpano` and nowhere else, except for the pure
functions of `photonpano.geometry`, `photonpano.photometry` and `photonpano.merging`.
"""

from photonpano.contributions import (
    Config,
    InterpolatorContribution,
    LocatorContribution,
    MergerContribution,
    Requirement,
    ResamplerContribution,
    SourceContext,
    SourceContribution,
    SpecPath,
    StageContext,
)
from photonpano.errors import (
    CanvasTooLargeError,
    InputError,
    LocationError,
    OutputError,
    PhotonpanoError,
    PluginError,
    SpecError,
)
from photonpano.hookspecs import hookimpl
from photonpano.protocols import Interpolator, Locator, Merger, Resampler, Source, Trajectory
from photonpano.values import (
    FrameSpan,
    Group,
    Located,
    NotLocated,
    Panorama,
    Response,
    StreamInfo,
    VirtualExposure,
)

__version__ = "0.1.0"

__all__ = [
    "CanvasTooLargeError",
    "Config",
    "FrameSpan",
    "Group",
    "InputError",
    "Interpolator",
    "InterpolatorContribution",
    "Located",
    "LocationError",
    "Locator",
    "LocatorContribution",
    "Merger",
    "MergerContribution",
    "NotLocated",
    "OutputError",
    "Panorama",
    "PhotonpanoError",
    "PluginError",
    "Requirement",
    "Resampler",
    "ResamplerContribution",
    "Response",
    "Source",
    "SourceContext",
    "SourceContribution",
    "SpecError",
    "SpecPath",
    "StageContext",
    "StreamInfo",
    "Trajectory",
    "VirtualExposure",
    "hookimpl",
]
