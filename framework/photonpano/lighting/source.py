"""Attach the light of a capture to its source."""

from __future__ import annotations

from photonpano.protocols import Source
from photonpano.source_wrapper import LitWrapper, SourceWrapper, capabilities_of, with_capabilities
from photonpano.values import Light


def in_light(source: Source, light: Light) -> InLight:
    """Return a capture with the gain of each of its frames: a `LitSource`."""
    capabilities = [each for each in capabilities_of(source) if each is not LitWrapper]
    return with_capabilities(InLight, capabilities)(source, light)


class InLight(SourceWrapper):
    """A source in light that changes: made by `in_light`. Its counts stay as they are; what sums them divides by the gains."""

    def __init__(self, source: Source, light: Light) -> None:
        super().__init__(source)
        self._light = light

    def around(self, source: Source) -> Source:
        """Return the source of one colour in the same light."""
        return in_light(source, self._light)

    @property
    def light(self) -> Light:
        """The gain of each frame."""
        return self._light
