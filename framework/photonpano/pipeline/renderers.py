"""Renderers of plugins: their errors name the plugin, and what they return is checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from photonpano.contracts.attribution import attributing
from photonpano.contracts.results import require_panorama
from photonpano.contracts.rules import BrokenContract
from photonpano.errors import InputError
from photonpano.geometry import Canvas
from photonpano.merging import MergeRenderer
from photonpano.merging.footprints import by_homographies
from photonpano.protocols import Renderer, Source, Trajectory, camera_of
from photonpano.values import FrameSpan, Panorama


@dataclass(frozen=True, slots=True)
class AttributedRenderer:
    """A renderer whose errors name its `origin`, and whose panoramas are checked.

    Attributes:
        bytes_per_pixel: peak memory of rendering for a pixel of the canvas.
        any_canvas: whether it renders on a canvas of any projection, and through a lens.
    """

    component: Renderer
    origin: str
    bytes_per_pixel: int
    any_canvas: bool = True

    @property
    def merges(self) -> bool:
        """Whether it renders what the residuals were measured against: the merge of all frames."""
        return isinstance(self.component, MergeRenderer)

    def render(
        self,
        source: Source,
        trajectory: Trajectory,
        span: FrameSpan,
        canvas: Canvas,
        tolerance_px: float,
        advance: Callable[[int], None],
    ) -> Panorama:
        """Render the frames of a span on a canvas.

        Raises:
            InputError: it renders no such canvas, or not through a lens.
            PluginError: the renderer failed, or broke its contract.
        """
        self._require_renderable(source, trajectory, span, canvas)
        with attributing(self.origin, "the panorama"):
            return require_panorama(self.component.render(source, trajectory, span, canvas, tolerance_px, advance), canvas)

    def _require_renderable(self, source: Source, trajectory: Trajectory, span: FrameSpan, canvas: Canvas) -> None:
        """Refuse what only a renderer on any canvas renders."""
        if self.any_canvas:
            return
        if not canvas.planar:
            raise InputError(
                f"{self.origin} renders on a plane only, and this panorama is {canvas.projection}; write render.use: merge, or "
                "render.projection: planar"
            )
        camera = camera_of(source)
        if camera is not None and camera.distorts:
            raise InputError(f"{self.origin} does not render through a lens that distorts; write render.use: merge")
        homographies = trajectory.at(np.arange(span.start, span.stop))
        if not by_homographies(canvas, camera, homographies, source.info.frame_shape):
            raise InputError(f"{self.origin} does not leave out frames that reach behind the plane; write render.use: merge")

    def require_seen(self, coverage_share: float) -> None:
        """Raise `PluginError` if nothing of the panorama was seen, although frames were located."""
        with attributing(self.origin, "the panorama"):
            if not coverage_share:
                raise BrokenContract("no pixel has a positive weight")
