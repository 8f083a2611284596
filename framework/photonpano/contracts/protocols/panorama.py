"""The interfaces of what a run ends in: components that render the panorama and write it, and other kinds of runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from photonpano.contracts.protocols.motion import Trajectory
from photonpano.contracts.protocols.sources import Source
from photonpano.values import FrameSpan, Homography, Panorama, PanoramaRows

if TYPE_CHECKING:
    from photonpano.geometry import Canvas


class Renderer(Protocol):
    """Renders the panorama: flux and weight on a canvas, from the frames and their motion."""

    def render(  # noqa: PLR0917
        self,
        source: Source,
        trajectory: Trajectory,
        span: FrameSpan,
        canvas: Canvas,
        tolerance_px: float,
        advance: Callable[[int], None],
    ) -> Panorama:
        """Render the frames of a span on a canvas.

        The framework chooses the canvas. One that exceeds the memory of the run is rendered in tiles, each with a call; what a
        pixel shows should not depend on the tile that it lies in.

        Convention:
            Points are (x, y), integers are pixel centres. A pixel p of frame t is at `canvas.transform @ trajectory.at(t) @ p`
            on a planar canvas, and on others at `canvas.pixels(canvas.plane_to_rays @ trajectory.at(t) @ p)`.
            p is an ideal pixel where the lens is known. A contribution without `renders_on_any_canvas` gets planar canvases,
            and no lens.

        Args:
            source: the capture. Pixels outside of its mask are left out; sums are corrected by `Capture.corrected`.
            trajectory: frame pixels to reference pixels.
            span: the frames to render.
            canvas: the pixel grid.
            tolerance_px: motion, in px of a frame, within which frames may be summed before they are warped.
            advance: called with the number of frames that are done; over the whole call these add up to the frames of the span.

        Returns:
            Flux in photons per pixel of a frame per frame, whatever the scale of the canvas, and its weight, with
            `canvas.transform` as canvas. Flux is NaN exactly where the weight is 0.
        """


class FinishedPanorama(Protocol):
    """A panorama that is rendered and stored. It may exceed the memory, so it is read in rows."""

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""

    @property
    def in_colour(self) -> bool:
        """Whether pixels have red, green and blue."""

    @property
    def canvas(self) -> Homography:
        """(3, 3), pixels of the reference plane to pixels of the panorama; from (a, b, 1) in radians if it is not planar."""

    @property
    def projection(self) -> str:
        """Of the canvas: planar, cylindrical or spherical."""

    @property
    def capture(self) -> str:
        """Name of the file or folder of the capture, or of its source."""

    @property
    def white_flux(self) -> float:
        """Flux that is white in panorama.png, photons per pixel per frame."""

    def rows(self, start: int, stop: int) -> PanoramaRows:
        """Return flux, weight, standard deviation and saturated pixels of the rows from `start` to `stop - 1`."""


class Exporter(Protocol):
    """Writes the panorama as a file of another format, or a folder of files."""

    def export(self, panorama: FinishedPanorama, path: Path) -> None:
        """Write one file or folder, and nothing else.

        The framework puts it into the run folder with the other results, and records the hash of each file.

        Args:
            panorama: what to write.
            path: the file or folder; it does not exist yet.
        """


class Score(Protocol):
    """The score of another kind of run against the truth of its capture. Experimental."""

    def rows(self) -> Sequence[tuple[str, str]]:
        """Return figures with their names, for people."""

    def data(self) -> Mapping[str, Any]:
        """Return figures with their names, for programs."""

    def figures(self) -> Mapping[str, Any]:
        """Return what the summary of a batch shows, by the attributes of `photonpano.BatchRow`."""


class RunKind(Protocol):
    """Does runs of a kind that finds something else than a panorama, and describes them. Experimental."""

    def run(self, run: Any) -> None:
        """Find it, write its files into `run.folder.staging`, and end the run with `run.end`.

        Args:
            run: the `photonpano.pipeline.run.BegunRun`; `photonpano.pipeline.components.build_finder` builds the component.
        """

    def rows(self, record: Mapping[str, Any]) -> Sequence[tuple[str, str]]:
        """Return what the command line and notebooks show of a finished run, with names, from its `run.json`."""

    def figures(self, record: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return what the summary of a batch shows of a finished run, by the attributes of `photonpano.BatchRow`."""

    def evaluate(self, run_folder: Path, truth: Path) -> Score:
        """Score a run folder against the truth of its capture; `InputError` if they are not of the same capture."""
