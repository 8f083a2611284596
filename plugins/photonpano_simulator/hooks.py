"""Hooks of the plugin."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import photonpano_simulator as plugin
from photonpano import SourceContribution, hookimpl
from photonpano.reading import missing_file, objections
from photonpano_simulator.config import CameraSimulatorConfig, FilePath, PhotoScene, Sensor, SimulatorConfig, delivered
from photonpano_simulator.travel_config import TravelConfig

_CHECKED_FRAMES = 5000  # frames of a path that are checked before a run, to find out whether it leaves the scene


def _check(config: SimulatorConfig | CameraSimulatorConfig) -> Sequence[str]:
    """Look for missing files, for wrong ranges of frames, and for a path that leaves the scene where its size is known."""
    files = [config.sensor.dark_rates, config.sensor.hot_pixels] if isinstance(config.sensor, Sensor) else []
    if isinstance(config.sensor, Sensor) and isinstance(config.sensor.filters, Path):
        files.append(config.sensor.filters)
    if isinstance(config.scene, PhotoScene):
        files.append(config.scene.file)
    if isinstance(config.path, FilePath):
        files.append(config.path.file)
    problems = [*_missing(files), *objections(delivered, config.n_frames, config.drops, config.repeats)]
    if not isinstance(config.scene, PhotoScene) and not isinstance(config.path, FilePath):
        # The shake depends on the seed of the run, which is not known yet.
        still = config.path.model_copy(update={"shake": None})
        checked = config.model_copy(update={"path": still, "n_frames": min(config.n_frames, _CHECKED_FRAMES)})
        problems += objections(plugin.camera_path, checked, (config.scene.height, config.scene.width), seed=0)
    return problems


def _check_travel(config: TravelConfig) -> Sequence[str]:
    """Look for missing files; then for wrong ranges of frames, and for a path that leaves the scene or runs into something."""
    if missing := _missing([config.sensor.dark_rates, config.sensor.hot_pixels, config.scene.photo]):
        return missing
    # The tremor depends on the seed of the run as well.
    still = config.path.model_copy(update={"tremor": None})
    checked = config.model_copy(update={"path": still, "n_frames": min(config.n_frames, _CHECKED_FRAMES)})
    return [*objections(delivered, config.n_frames, config.drops, config.repeats), *objections(plugin.placed, checked, seed=0)]


def _missing(files: Sequence[Path | None]) -> list[str]:
    return [missing_file(file) for file in files if file is not None and not file.is_file()]


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution]:
    """Offer the simulators."""
    yield SourceContribution(
        name="simulator",
        summary="A simulated single-photon camera that rotates in front of a photograph or the built-in street",
        config=SimulatorConfig,
        build=lambda config, context: plugin.SimulatorSource(config, context),
        check=_check,
    )
    yield SourceContribution(
        name="camera-simulator",
        summary="A simulated conventional camera with photon noise and read noise, in front of the same scenes",
        config=CameraSimulatorConfig,
        build=lambda config, context: plugin.SimulatorSource(config, context),
        check=_check,
    )
    yield SourceContribution(
        name="travel-simulator",
        summary="A simulated single-photon camera that travels through a scene with depth",
        config=TravelConfig,
        build=lambda config, context: plugin.TravelSource(config, context),
        check=_check_travel,
    )
