"""Discovery of plugins and the catalog of what they contribute."""

from photonpano.plugins.contributions import KINDS as KINDS
from photonpano.plugins.contributions import Kind as Kind

from .catalog import BrokenPlugin as BrokenPlugin
from .catalog import Catalog as Catalog
from .catalog import DisabledPlugin as DisabledPlugin
from .catalog import Entry as Entry
from .catalog import Observer as Observer
from .catalog import Origin as Origin
from .catalog import discover as discover
