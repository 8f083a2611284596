"""The built-in scene: a drawing of a street of shops."""

from photonpano_simulator.street.scene import street

__all__ = ["street"]
