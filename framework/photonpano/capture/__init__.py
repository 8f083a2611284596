"""One record of a capture as a run sees it: what its source gives, and what was found about it."""

from .capture import MISSING as MISSING
from .capture import Capture as Capture
from .capture import Colours as Colours
from .capture import Gather as Gather
from .capture import Index as Index
from .capture import LinearCorrection as LinearCorrection
from .capture import MaskedSpan as MaskedSpan
from .capture import capture_of as capture_of
from .capture import in_light as in_light
from .capture import leaving_out as leaving_out
from .capture import numbered as numbered
from .capture import part_of as part_of
from .capture import seen_through as seen_through
from .capture import with_background as with_background
from .plugin_source import PluginSource as PluginSource
