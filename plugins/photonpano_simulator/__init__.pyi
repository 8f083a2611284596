from .paths import camera_path as camera_path
from .source import SimulatorSource as SimulatorSource
from .travel import TravelSource as TravelSource
from .travel import placed as placed
