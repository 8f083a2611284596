"""The interfaces of the components that plugins build."""

from .motion import InterpolatesTurns as InterpolatesTurns
from .motion import Interpolator as Interpolator
from .motion import KeepsHypotheses as KeepsHypotheses
from .motion import LocatesTurns as LocatesTurns
from .motion import Locator as Locator
from .motion import Merger as Merger
from .motion import PanoramaView as PanoramaView
from .motion import Refiner as Refiner
from .motion import Resampler as Resampler
from .motion import Trajectory as Trajectory
from .motion import camera_of_motion as camera_of_motion
from .panorama import Exporter as Exporter
from .panorama import FinishedPanorama as FinishedPanorama
from .panorama import Renderer as Renderer
from .panorama import RunKind as RunKind
from .panorama import Score as Score
from .sources import Arrived as Arrived
from .sources import Closing as Closing
from .sources import ColouredSource as ColouredSource
from .sources import KnowsSharpViews as KnowsSharpViews
from .sources import KnowsTruth as KnowsTruth
from .sources import PackedSource as PackedSource
from .sources import Piped as Piped
from .sources import Source as Source
from .sources import camera_of as camera_of
from .sources import light_of as light_of
