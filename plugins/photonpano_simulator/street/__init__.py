"""The built-in scene: a drawing of a street of shops, and paint for it."""

from photonpano_simulator.street.paint import paint
from photonpano_simulator.street.scene import street

__all__ = ["paint", "street"]
