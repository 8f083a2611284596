"""Attribution of errors to components: see `photonpano.protocols.attribution`."""

from photonpano.protocols.attribution import AttributedTrajectory, BrokenContract, attributing, shown

__all__ = ["AttributedTrajectory", "BrokenContract", "attributing", "shown"]
