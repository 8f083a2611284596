"""A street of shops, drawn: the scene that is built in."""

from photonpano_simulator.street.scene import street

__all__ = ["street"]
