"""The interface of a kind of run that finds something else than a panorama. Experimental."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol


class Score(Protocol):
    """The score of a run against the truth of its capture."""

    def rows(self) -> Sequence[tuple[str, str]]:
        """Return figures with their names, for people."""

    def data(self) -> Mapping[str, Any]:
        """Return figures with their names, for programs."""

    def figures(self) -> Mapping[str, Any]:
        """Return what the summary of a batch shows, by the attributes of `photonpano.BatchRow`."""


class RunKind(Protocol):
    """Does runs of one kind, and describes them."""

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
