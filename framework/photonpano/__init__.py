"""photonpano: sharp panoramas from single-photon cameras.

These names are public, and so are those of `photonpano.geometry`, `photonpano.photometry`, `photonpano.merging`,
`photonpano.locating`, `photonpano.reading` and `photonpano.compiling`. Plugins and notebooks import nothing else.
A name is imported when it is first used, so that the help of the command line needs no numpy.
"""

from typing import TYPE_CHECKING

from photonpano.lazy import imported_on_use

if TYPE_CHECKING:
    from photonpano.api.capture_info import CaptureInfo, info
    from photonpano.api.captures import WrittenCapture, convert, simulate
    from photonpano.api.dark_counts import DarkMeasurement, dark
    from photonpano.api.explanation import explain, forecast
    from photonpano.api.pictures import Preview, preview
    from photonpano.api.runs import evaluate, warm_up
    from photonpano.contributions import (
        Config,
        InterpolatorContribution,
        LocatorContribution,
        MergerContribution,
        Recognised,
        Requirement,
        ResamplerContribution,
        SourceContext,
        SourceContribution,
        SpecPath,
        StageContext,
    )
    from photonpano.errors import (
        CanvasTooLargeError,
        CaptureUnreadError,
        InputError,
        LocationError,
        OutputError,
        PhotonpanoError,
        PluginError,
        SpecError,
    )
    from photonpano.evaluation import Evaluation
    from photonpano.hookspecs import hookimpl
    from photonpano.pipeline.components import open_source
    from photonpano.pipeline.forecast import Forecast
    from photonpano.pipeline.run import RunResult, run
    from photonpano.protocols import (
        Interpolator,
        KnowsTruth,
        LinearlyCorrectedSource,
        Locator,
        Merger,
        PackedSource,
        Resampler,
        Source,
        Trajectory,
    )
    from photonpano.registry import Catalog, discover
    from photonpano.specs import Plan, capture_plan, load_spec, parse_spec
    from photonpano.values import (
        BoolArray,
        CaptureSummary,
        Counts,
        FloatArray,
        FluxImage,
        Frames,
        FrameSpan,
        Group,
        Homography,
        Located,
        NotLocated,
        Panorama,
        Response,
        StreamInfo,
        VirtualExposure,
    )

__version__ = "0.1.0"

__all__ = [
    "BoolArray",
    "CanvasTooLargeError",
    "CaptureInfo",
    "CaptureSummary",
    "CaptureUnreadError",
    "Catalog",
    "Config",
    "Counts",
    "DarkMeasurement",
    "Evaluation",
    "FloatArray",
    "FluxImage",
    "Forecast",
    "FrameSpan",
    "Frames",
    "Group",
    "Homography",
    "InputError",
    "Interpolator",
    "InterpolatorContribution",
    "KnowsTruth",
    "LinearlyCorrectedSource",
    "Located",
    "LocationError",
    "Locator",
    "LocatorContribution",
    "Merger",
    "MergerContribution",
    "NotLocated",
    "OutputError",
    "PackedSource",
    "Panorama",
    "PhotonpanoError",
    "Plan",
    "PluginError",
    "Preview",
    "Recognised",
    "Requirement",
    "Resampler",
    "ResamplerContribution",
    "Response",
    "RunResult",
    "Source",
    "SourceContext",
    "SourceContribution",
    "SpecError",
    "SpecPath",
    "StageContext",
    "StreamInfo",
    "Trajectory",
    "VirtualExposure",
    "WrittenCapture",
    "capture_plan",
    "convert",
    "dark",
    "discover",
    "evaluate",
    "explain",
    "forecast",
    "hookimpl",
    "info",
    "load_spec",
    "open_source",
    "parse_spec",
    "preview",
    "run",
    "simulate",
    "warm_up",
]

if not TYPE_CHECKING:  # type checkers see the imports, and so know which names there are
    _LIGHT = ("errors", "values", "protocols", "contributions", "hookspecs", "registry", "specs")
    _API = ("captures", "dark_counts", "pictures", "capture_info", "explanation", "runs")
    _HEAVY = ("pipeline.components", "pipeline.run", *(f"api.{each}" for each in _API), "pipeline.forecast")
    __getattr__, __dir__ = imported_on_use(__name__, __all__, (*_LIGHT, *_HEAVY))
