from .paths import camera_path as camera_path
from .source import SimulatorSource as SimulatorSource
from .travel.source import TravelSource as TravelSource
from .travel.source import placed as placed
