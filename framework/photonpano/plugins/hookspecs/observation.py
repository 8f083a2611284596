"""The hooks that watch runs."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from photonpano.plugins.contributions import hookspec


@hookspec
def photonpano_run_started(directory: Path, spec: Mapping[str, Any]) -> None:
    """Watch a run begin, before its capture is opened.

    Observation hooks look and do not touch: what they are given is frozen, what they return is ignored, and what they raise is
    logged with the name of their plugin, while the run goes on. They are called in the thread that runs, one after the other. A
    plugin takes those of the arguments that it needs, by name.

    Args:
        directory: the run folder. It may not be there yet, and belongs to the run: write elsewhere.
        spec: the resolved spec, defaults filled in.

    Example:
        ```python
        import sys

        from photonpano import hookimpl


        @hookimpl
        def photonpano_run_started(directory, spec):
            print(f"{directory}: begins with {spec['source']['use']}, seed {spec['run']['seed']}", file=sys.stderr)
        ```
    """


@hookspec
def photonpano_stage_finished(
    directory: Path, level: int | None, stage: str, seconds: float, summary: Mapping[str, float | None]
) -> None:
    """Watch a stage end. Merging and locating alternate, so the hook is called for all four stages when the level is done.

    A run with `pose` has the stage "pose" only: levels belong to the pose estimator.

    Args:
        directory: the run folder, by which runs can be distinguished.
        level: from 1; None for the panorama and for poses.
        stage: "resample", "merge", "locate" or "interpolate"; at the end of the run "render"; with `pose` only "pose".
        seconds: how long it took.
        summary: its results. resample: `groups`; merge: `exposures`; locate: `pairs`, `failed` pairs and `located`
            exposures; interpolate: `change_px` (None at level 1) and `std_px` (None if not known), as in `run.json`; render:
            `height` and `width` of the panorama; pose: numbers of `located` frames, of `exposures` and of `points`.

    Example:
        ```python
        import sys

        from photonpano import hookimpl


        @hookimpl
        def photonpano_stage_finished(level, stage, seconds):
            where = "" if level is None else f"level {level}: "
            print(f"{where}{stage} took {seconds:.1f} s", file=sys.stderr)
        ```
    """


@hookspec
def photonpano_run_finished(directory: Path, record: Mapping[str, Any] | None, error: str | None) -> None:
    """Watch a run end, well or not: called once for each run that started.

    Args:
        directory: the run folder; complete if the run ended well, else as it was before.
        record: the content of `run.json`; None if the run failed.
        error: the class of what ended the run, and its message; None if it ended well.

    Example:
        ```python
        import sys

        from photonpano import hookimpl


        @hookimpl
        def photonpano_run_finished(directory, record, error):
            print(f"{directory}: {error or 'done'}", file=sys.stderr)
        ```
    """
