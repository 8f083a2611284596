"""Call the observation hooks of plugins during a run. They cannot change it, and their exceptions are logged."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from photonpano.errors import described, public_name
from photonpano.geometry import Canvas
from photonpano.motion.loop import LevelResult
from photonpano.plugins.registry import Observer

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Observers:
    """The observers of one run, which writes into `directory`; by default there are none."""

    observers: tuple[Observer, ...] = ()
    directory: Path = Path()

    @contextmanager
    def watching(self, spec: Mapping[str, Any]) -> Iterator[Callable[[Mapping[str, Any]], None]]:
        """Report the start of a run, and its end: an error, or the record that the block passes to the yielded function."""
        self._call("photonpano_run_started", spec=frozen(spec))
        records: list[Mapping[str, Any]] = []
        try:
            yield records.append
        except BaseException as error:  # an interrupt ends a run as well
            message = f"{public_name(error)}: {error}" if str(error) else public_name(error)
            self._call("photonpano_run_finished", record=None, error=message)
            raise
        self._call("photonpano_run_finished", record=frozen(records[-1]), error=None)

    def level_finished(self, result: LevelResult) -> None:
        """Report the four stages of a level."""
        located, std_px = result.located, result.uncertainty.mean_px
        summaries: dict[str, dict[str, float | None]] = {
            "resample": {"groups": len(result.groups)},
            "merge": {"exposures": len(result.groups)},
            "locate": {"pairs": len(located.edges), "failed": len(located.failures), "located": located.n_located},
            "interpolate": {"change_px": result.change_px, "std_px": std_px if np.isfinite(std_px) else None},
        }
        for stage, summary in summaries.items():
            self.stage_finished(result.level.number, stage, result.seconds.get(stage, 0.0), summary)

    def rendered(self, canvas: Canvas, seconds: float) -> None:
        """Report the panorama."""
        self.stage_finished(None, "render", seconds, {"height": canvas.height, "width": canvas.width})

    def stage_finished(self, level: int | None, stage: str, seconds: float, summary: Mapping[str, float | None]) -> None:
        """Report a stage, which belongs to no level if that is None."""
        self._call("photonpano_stage_finished", level=level, stage=stage, seconds=seconds, summary=frozen(summary))

    def _call(self, hook: str, **values: Any) -> None:
        for observer in self.observers:
            try:
                getattr(observer.hook, hook)(directory=self.directory, **values)
            except Exception as error:
                what = described(error)
                logger.warning("%s of %s raised %s; the run goes on", hook, observer.origin, what, exc_info=True)


def frozen(value: Any) -> Any:
    """Return a copy of plain data that cannot be changed: mappings become read-only views, lists become tuples."""
    if isinstance(value, Mapping):
        return MappingProxyType({key: frozen(item) for key, item in value.items()})
    return tuple(map(frozen, value)) if isinstance(value, list | tuple) else value
