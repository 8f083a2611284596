"""Pipeline specs: read with the places of values, validated, all problems at once.

A name is imported when it is first used: discovery of plugins imports `builtin` from here, and needs no reader of YAML.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
