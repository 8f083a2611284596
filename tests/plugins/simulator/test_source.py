"""Simulated captures of a plane: settings, frames, truth and sensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from photonpano import FrameSpan, InputError, SourceContext
from photonpano.capture.writing import write_packed
from photonpano_simulator.camera import Draw, IntensityCamera, SpadSensor, generator
from photonpano_simulator.config import CameraSimulatorConfig, IntensitySensor, Sensor, SimulatorConfig
from photonpano_simulator.hooks import photonpano_sources
from photonpano_simulator.source import SimulatorSource

SIMULATOR, CAMERA, _ = photonpano_sources()


def z_scores(counts: np.ndarray, n_frames: int, flux: Any) -> np.ndarray:
    """Return the deviations of counts of a binary camera from a flux, in standard deviations of photon noise."""
    chance = -np.expm1(-np.asarray(flux, np.float64))
    return (counts - n_frames * chance) / np.sqrt(n_frames * chance * (1 - chance))


def problems(**settings: Any) -> list[str]:
    return list(SIMULATOR.check(SimulatorConfig.model_validate(settings)))


def test_defaults_are_small_demos() -> None:
    config = SimulatorConfig()
    assert (config.n_frames, config.frame_shape, config.scene.kind, config.path.kind) == (2000, (254, 496), "street", "pan")
    assert problems() == []
    camera = CAMERA.config()
    assert (camera.n_frames, camera.frame_rate_hz, camera.sensor.bits) == (200, 500, 8)
    assert CAMERA.check(camera) == []


def test_check_refuses_path_that_leaves_the_street() -> None:
    scene = {"kind": "street", "width": 800, "height": 600}
    assert problems(scene=scene, path={"kind": "pan", "length_px": 400, "shake": {}}, n_frames=1_000_000) == [
        "the camera path leaves the scene of 600x800 px by 49.1 px at the right, 100% of the way along; "
        "shorten or move the path, or take a larger scene"
    ]
    (problem,) = problems(path={"kind": "file", "file": "nowhere.npy"})
    assert problem == "there is no file nowhere.npy; check the path"


@pytest.mark.parametrize(
    ("settings", "place"),
    [
        ({"flux": 0}, "flux"),
        ({"flux": float("nan")}, "flux"),
        ({"n_frames": 0}, "n_frames"),
        ({"frame_shape": (254, 4)}, "frame_shape"),
        ({"sensor": {"quantum_efficiency": 1.5}}, "sensor"),
        ({"sensor": {"hot_rate": (0, 1)}}, "sensor"),
        ({"path": {"kind": "zigzag"}}, "path"),
        ({"path": {"kind": "pan", "rows": 3}}, "path"),
        ({"path": {"kind": "pan", "shake": {"frequencies_hz": ()}}}, "path"),
        ({"lens": {"k1": 0.3}}, "lens"),
        ({"lens": {"vignette": 1.1}}, "lens"),
        ({"objects": [{"size": (0, 1)}]}, "objects"),
        ({"drops": [{"frames": 3}]}, "drops"),
        ({"drift": 0}, "drift"),
        ({"exposure": 1}, "exposure"),
    ],
)
def test_values_out_of_range_are_refused(settings: dict[str, Any], place: str) -> None:
    with pytest.raises(ValidationError) as caught:
        SimulatorConfig.model_validate(settings)
    assert {error["loc"][0] for error in caught.value.errors()} == {place}


Simulated = Callable[..., SimulatorSource]
NOISY = {"sensor": {"dark_rate": 0.01, "hot_fraction": 0.05}, "path": {"kind": "loop", "length_px": 100, "shake": {}}}


@pytest.fixture
def opencv_threads() -> Iterator[None]:
    before = cv2.getNumThreads()
    yield
    cv2.setNumThreads(before)


@pytest.mark.usefixtures("opencv_threads")
def test_frames_do_not_depend_on_the_threads_of_opencv(simulated: Simulated) -> None:
    frames = []
    for threads in (1, 2, 3):
        cv2.setNumThreads(threads)
        frames.append(simulated(**NOISY).frames(FrameSpan(0, 20)))
    np.testing.assert_array_equal(frames[0], frames[1])
    np.testing.assert_array_equal(frames[0], frames[2])


def test_frames_are_independent(simulated: Simulated) -> None:
    """Neither in time nor in space does a pixel tell of another, beyond the scene."""
    source = simulated(n_frames=4000, path={"kind": "pan", "length_px": 1e-6}, flux=0.5)
    frames = source.frames(source.info.span).astype(np.float32)
    deviations = (frames - frames.mean(axis=0)) / frames.std(axis=0)
    n = deviations[1:].size
    for product in (
        deviations[1:] * deviations[:-1],
        deviations[7:] * deviations[:-7],
        deviations[:, :, 1:] * deviations[:, :, :-1],
        deviations[:, 1:] * deviations[:, :-1],
    ):
        # The mean of n products of independent unit deviations has the standard deviation 1 / sqrt(n).
        assert abs(product.mean(dtype=np.float64)) < 5 / np.sqrt(n)


def test_frames_agree_with_the_truth(simulated: Simulated) -> None:
    source = simulated(n_frames=3000, path={"kind": "pan", "length_px": 1e-6, "centre": (90.3, 70.6)}, flux=0.5)
    truth = source.truth()
    height, width = truth["frame_shape"]
    y, x = np.mgrid[:height, :width]
    points = np.stack([x, y, np.ones_like(x)], axis=-1) @ truth["homographies"][0].T
    px, py = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    flux = cv2.remap(truth["scene"], px.astype(np.float32), py.astype(np.float32), cv2.INTER_LINEAR)
    z = z_scores(source.counts(source.info.span), 3000, flux)
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert abs(z.var() - 1) < 5 * np.sqrt(2 / z.size)


def test_written_capture_has_the_same_frames(simulated: Simulated, tmp_path: Path) -> None:
    source = simulated(**NOISY, frame_shape=(40, 51))
    path, truth_path = write_packed(source, tmp_path / "cube.npy")
    packed = np.load(path, allow_pickle=False)
    assert packed.shape == (50, 40, 7)
    np.testing.assert_array_equal(np.unpackbits(packed, axis=-1, count=51), source.frames(source.info.span))
    with np.load(truth_path, allow_pickle=False) as truth:
        names = (
            "camera_matrix dark_rates frame_rate_hz frame_shape homographies hot_pixels rotations scene scene_projection seed"
        )
        assert sorted(truth) == names.split()
        assert (truth["homographies"].shape, truth["homographies"].dtype) == ((50, 3, 3), np.float64)
        assert (truth["scene"].shape, truth["scene"].dtype) == ((150, 200), np.float32)
        assert truth["frame_shape"].tolist() == [40, 51]
        homographies = truth["homographies"]

    replayed = simulated(sensor=NOISY["sensor"], frame_shape=(40, 51), path={"kind": "file", "file": truth_path})
    np.testing.assert_allclose(replayed.truth()["homographies"], homographies, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("fill_factor", "side"), [(1.0, 4), (0.25, 2), (0.05, 1)])
def test_pixels_before_a_finer_scene_average_it_over_their_areas(simulated: Simulated, fill_factor: float, side: int) -> None:
    keys = {"scene_scale": 4, "fill_factor": fill_factor, "path": {"kind": "pan", "length_px": 1e-9}, "flux": 0.3}
    with simulated(n_frames=2000, frame_shape=(24, 32), **keys) as source:
        truth = source.truth()
        lit = source.counts(source.info.span) / 2000
    scene, to_scene = truth["scene"], truth["homographies"][0]
    assert to_scene[0, 0] == pytest.approx(4, rel=1e-3)
    expected = np.zeros(lit.shape)
    for row in range(lit.shape[0]):
        for column in range(lit.shape[1]):
            u, v, depth = to_scene @ (column, row, 1)
            x, y = np.floor(np.array([u, v]) / depth - (side - 1) / 2 + 1e-3).astype(int)
            expected[row, column] = scene[y : y + side, x : x + side].mean()
    assert np.corrcoef(lit.ravel(), -np.expm1(-expected).ravel())[0, 1] > 0.97


SHAPE = (60, 81)
CAMERA_SHAPE = (200, 301)


def counts(sensor: SpadSensor, flux: float, n_frames: int) -> np.ndarray:
    total = np.zeros(SHAPE)
    for index in range(n_frames):
        total += sensor.expose(np.full(SHAPE, flux, np.float32), generator(0, Draw.PHOTONS, index))
    return total


@pytest.mark.parametrize(("flux", "dark"), [(0.5, 0.0), (0.02, 0.0), (0.1, 0.05), (3.0, 0.0), (0.0, 0.01)])
def test_pixel_is_lit_with_probability_of_equation_2(flux: float, dark: float) -> None:
    n = 400
    chance = 1 - np.exp(-(flux + dark))
    z = z_scores(counts(SpadSensor(Sensor(dark_rate=dark), SHAPE, 0), flux, n), n, flux + dark)
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    # The variance of a binomial count's square deviation is 2 + (1 - 6 p (1 - p)) / (n p (1 - p)).
    kurtosis = 2 + (1 - 6 * chance * (1 - chance)) / (n * chance * (1 - chance))
    assert abs(z.var() - 1) < 5 * np.sqrt(kurtosis / z.size)


def test_hot_pixels_have_fraction_and_rates_of_the_config() -> None:
    sensor = SpadSensor(Sensor(hot_fraction=0.3, hot_rate=(0.01, 1.0), dark_rate=0.5), (200, 200), seed=3)
    share = sensor.hot.mean()
    assert abs(share - 0.3) < 5 * np.sqrt(0.3 * 0.7 / 40_000)
    np.testing.assert_array_equal(sensor.dark_rates[~sensor.hot], np.float32(0.5))
    logarithms = np.log10(sensor.dark_rates[sensor.hot] - 0.5)
    assert -2.001 < logarithms.min() < -1.95
    assert -0.05 < logarithms.max() < 0.001
    assert abs(logarithms.mean() + 1) < 5 * 2 / np.sqrt(12 * logarithms.size)
    assert (SpadSensor(Sensor(hot_fraction=0.3), (200, 200), seed=4).hot != sensor.hot).any()


@pytest.mark.parametrize(
    ("field", "array", "message"),
    [
        (
            "dark_rates",
            np.zeros((2, 3)),
            "{path} holds float64 of shape (2, 3); rates are numbers of the frame's shape (60, 81)",
        ),
        ("dark_rates", np.full(SHAPE, -1.0), "{path} holds rates that are negative or not finite"),
        ("dark_rates", np.full(SHAPE, np.nan), "{path} holds rates that are negative or not finite"),
        ("hot_pixels", np.zeros(SHAPE), "{path} holds float64 of shape (60, 81); a mask is bool of the frame's shape (60, 81)"),
        ("hot_pixels", np.array([{}]), "{path} is not a mask: it is no .npy or .npz file of plain numbers"),
        ("hot_pixels", None, "there is no file {path}; check the path"),
    ],
)
def test_wrong_rate_and_mask_files_are_refused(tmp_path: Path, field: str, array: np.ndarray | None, message: str) -> None:
    path = tmp_path / "file.npy"
    if array is not None:
        np.save(path, array)
    with pytest.raises(InputError) as caught:
        SpadSensor(Sensor.model_validate({field: path}), SHAPE, 0)
    assert str(caught.value) == message.format(path=path)


def exposed(flux: float, **keys: float) -> tuple[IntensityCamera, np.ndarray]:
    camera = IntensityCamera(IntensitySensor(**keys), CAMERA_SHAPE, seed=0)
    return camera, camera.expose(np.full(CAMERA_SHAPE, flux, np.float32), generator(0, Draw.PHOTONS))


@pytest.mark.parametrize(("bits", "read_noise"), [(8, 20.0), (8, 0.0), (12, 20.0), (16, 5.0)])
def test_levels_have_mean_and_noise_of_the_response(bits: int, read_noise: float) -> None:
    flux = 1000.0
    camera, levels = exposed(flux, bits=bits, read_noise=read_noise, black_level=10)
    estimate = camera.response.flux(levels.astype(np.float32), 1)
    variance = flux + camera.response.read_noise**2
    assert estimate.mean(dtype=np.float64) == pytest.approx(flux, abs=5 * np.sqrt(variance / levels.size))
    assert estimate.var(dtype=np.float64) == pytest.approx(variance, rel=0.05)


def test_open_shutter_blurs_along_the_motion_and_keeps_the_flux() -> None:
    def frame(exposure: float) -> np.ndarray:
        config = CameraSimulatorConfig.model_validate(
            {
                "scene": {"kind": "street", "width": 512, "height": 341},
                "path": {"kind": "pan", "length_px": 200},
                "n_frames": 11,
                "frame_shape": (80, 100),
                "sensor": {"full_well": 1e7, "bits": 16, "read_noise": 0, "exposure": exposure},
                "flux": 1e6,
            }
        )
        with SimulatorSource(config, SourceContext()) as source:
            return source.counts(FrameSpan(5, 6)).astype(float)

    sharp, blurred = frame(0.0), frame(0.8)
    assert blurred[:, 20:-20].mean() == pytest.approx(sharp[:, 20:-20].mean(), rel=0.05)
    # 16 px along x, as an average of the sharp one over as many says.
    averaged = np.mean([np.roll(sharp, shift, axis=1) for shift in range(-8, 9)], axis=0)
    inside = np.s_[:, 12:-12]
    assert np.corrcoef(blurred[inside].ravel(), averaged[inside].ravel())[0, 1] > 0.99
    assert np.corrcoef(blurred[inside].ravel(), sharp[inside].ravel())[0, 1] < 0.95
