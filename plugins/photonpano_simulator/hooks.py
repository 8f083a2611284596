"""What this plugin contributes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from photonpano import InputError, SourceContribution, hookimpl
from photonpano.reading import missing_file
from photonpano_simulator.config import CameraSimulatorConfig, FilePath, PhotoScene, Sensor, SimulatorConfig
from photonpano_simulator.travel_config import TravelConfig

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from photonpano import SourceContext
    from photonpano_simulator.source import SimulatorSource
    from photonpano_simulator.travel.source import TravelSource

_CHECKED_FRAMES = 5000  # frames of a path that are checked before a run, to find out whether it leaves the scene


def _build(config: SimulatorConfig | CameraSimulatorConfig, context: SourceContext) -> SimulatorSource:
    from photonpano_simulator.source import SimulatorSource

    return SimulatorSource(config, context)


def _check(config: SimulatorConfig | CameraSimulatorConfig) -> Sequence[str]:
    """Look for missing files, for wrong ranges of frames, and for a path that leaves the scene where its size is known."""
    from photonpano_simulator.recording import delivered

    files = [config.sensor.dark_rates, config.sensor.hot_pixels] if isinstance(config.sensor, Sensor) else []
    if isinstance(config.sensor, Sensor) and isinstance(config.sensor.filters, Path):
        files.append(config.sensor.filters)
    if isinstance(config.scene, PhotoScene):
        files.append(config.scene.file)
    if isinstance(config.path, FilePath):
        files.append(config.path.file)
    problems = [missing_file(file) for file in files if file is not None and not file.is_file()]
    try:
        delivered(config.n_frames, config.drops, config.repeats)
    except InputError as error:
        problems.append(str(error))
    if not isinstance(config.scene, PhotoScene) and not isinstance(config.path, FilePath):
        from photonpano_simulator.paths import camera_path

        # The shake depends on the seed of the run, which is not known yet.
        still = config.path.model_copy(update={"shake": None})
        checked = config.model_copy(update={"path": still, "n_frames": min(config.n_frames, _CHECKED_FRAMES)})
        try:
            camera_path(checked, (config.scene.height, config.scene.width), seed=0)
        except InputError as error:
            problems.append(str(error))
    return problems


def _build_travel(config: TravelConfig, context: SourceContext) -> TravelSource:
    from photonpano_simulator.travel.source import TravelSource

    return TravelSource(config, context)


def _check_travel(config: TravelConfig) -> Sequence[str]:
    """Look for missing files; then for wrong ranges of frames, and for a path that leaves the scene or runs into something."""
    files = [config.sensor.dark_rates, config.sensor.hot_pixels, config.scene.photo]
    problems = [missing_file(file) for file in files if file is not None and not file.is_file()]
    if problems:
        return problems
    from photonpano_simulator.travel.source import problems_of

    return problems_of(config)


@hookimpl
def photonpano_sources() -> Iterator[SourceContribution]:
    """Offer the simulators."""
    yield SourceContribution(
        name="simulator",
        summary="A simulated single-photon camera that rotates in front of a photograph or the built-in street",
        config=SimulatorConfig,
        build=_build,
        check=_check,
    )
    yield SourceContribution(
        name="camera-simulator",
        summary="A simulated conventional camera with photon noise and read noise, in front of the same scenes",
        config=CameraSimulatorConfig,
        build=_build,
        check=_check,
    )
    yield SourceContribution(
        name="travel-simulator",
        summary="A simulated single-photon camera that travels through a scene with depth",
        config=TravelConfig,
        build=_build_travel,
        check=_check_travel,
    )
