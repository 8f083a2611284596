"""What happens at real places: people, boards at a distance, rests, cuts, a closed shutter, and sensors that remember."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from photonpano import InputError, SourceContext
from photonpano.geometry import Camera
from photonpano_simulator import scenes
from photonpano_simulator.camera import SpadSensor
from photonpano_simulator.config import Sensor, SimulatorConfig
from photonpano_simulator.paths import pace
from photonpano_simulator.scenes import street
from photonpano_simulator.source import SimulatorSource

SHAPE = (64, 96)
drawn_once = cache(street)
TURN: dict[str, Any] = {"kind": "turn", "degrees": 40, "pitch_wobble_deg": 2, "wobbles": 1}
LENS = {"k1": -0.1, "k2": 0.03}
STEP = (0.2, 0.05, 0.1)


@pytest.fixture(autouse=True)
def quick_street(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw each street once for all tests."""
    monkeypatch.setattr(scenes, "street", drawn_once)


def config(**changes: Any) -> SimulatorConfig:
    scene = {"kind": "street", "width": 512, "height": 256}
    base = {"scene": scene, "path": TURN, "frame_shape": SHAPE, "focal_length_px": 80.0, "n_frames": 1000, "flux": 0.5}
    return SimulatorConfig.model_validate(base | changes)


def simulated(**changes: Any) -> SimulatorSource:
    return SimulatorSource(config(**changes), SourceContext(seed=0))


def seen_of(board: dict[str, Any], truth: dict[str, Any], frame: int) -> tuple[np.ndarray, np.ndarray]:
    """Intersect the rays of all pixels with a board: how far (H, W) they are outside of it in m, and the depth there."""
    camera = Camera(truth["camera_matrix"], truth.get("distortion", np.zeros(4)))
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    ideal = camera.directions(np.stack([x, y], axis=-1))
    ideal /= ideal[..., 2:]
    azimuth, elevation = np.deg2rad(board["at_deg"])
    angle = azimuth + np.deg2rad(board["slant_deg"])
    middle = board["distance_m"] * np.array([np.sin(azimuth), np.tan(elevation), np.cos(azimuth)])
    right, normal = np.array([np.cos(angle), 0, -np.sin(angle)]), np.array([np.sin(angle), 0, np.cos(angle)])
    rays, start = ideal @ truth["rotations"][frame].T, truth["camera_positions"][frame]
    depth = (middle - start) @ normal / (rays @ normal)
    offsets = start + depth[..., None] * rays - middle
    outside = np.maximum(abs(offsets @ right) - board["size_m"][0] / 2, abs(offsets[..., 1]) - board["size_m"][1] / 2)
    return np.where(depth > 0, outside, np.inf), depth


@pytest.mark.parametrize("path", [TURN, {"kind": "pan", "length_px": 60, "angle_deg": 20}])
def test_boards_are_where_a_camera_that_travels_sees_them(path: dict[str, Any]) -> None:
    near = {"distance_m": 1.5, "at_deg": (12, -4), "size_m": (0.6, 0.5), "slant_deg": 30.0, "seed": 1}
    far = {"distance_m": 3.0, "at_deg": (6, 2), "size_m": (1.0, 0.8), "slant_deg": -20.0}
    source = simulated(path=path | {"travel_m": STEP}, distortion=LENS, boards=[near, far])
    truth = source.truth()
    np.testing.assert_allclose(truth["camera_positions"][[0, -1]], [(0, 0, 0), STEP], atol=1e-12)
    for place, frame in enumerate(truth["labelled_frames"]):
        expected = np.zeros(SHAPE, int)
        sure = np.ones(SHAPE, bool)
        for label, board in ((2, far), (1, near)):
            outside, depth = seen_of(board, truth, frame)
            expected[outside <= 0] = label
            sure &= abs(outside) > 0.002  # a tenth of a pixel
            there = sure & (truth["labels"][place] == label) & (expected == label)
            np.testing.assert_allclose(truth["depth"][place][there], depth[there], rtol=1e-5)
        assert (truth["labels"][place] == expected)[sure].all()
    assert {1, 2} <= set(truth["labels"].ravel())
    assert np.isinf(truth["depth"][truth["labels"] == 0]).all()


def test_people_walk_both_ways_come_again_and_stand_still() -> None:
    source = simulated(n_frames=6000, path={"kind": "hand-shake", "shake": {"rms_px": 1e-9}}, scene={"kind": "street"},
                       people={"share": 0.1, "number": 2, "speed_px": 0.2, "pauses": 0.5})  # fmt: skip
    truth = source.truth()
    for label, side in ((1, 1), (2, -1)):
        there = truth["labels"] == label
        x = np.array([np.flatnonzero(each.any(axis=0)).mean() if each.any() else np.nan for each in there])
        inside = np.isfinite(x) & (abs(x - 47.5) < 30)
        steps = np.diff(x)[inside[1:] & inside[:-1]]
        assert np.mean(side * steps > -1) > 0.95
        assert np.sum(side * np.diff(x) < -40) + np.sum(np.diff(inside.astype(int)) == 1) >= 2  # enters more than once
        assert 0.25 < np.mean(abs(steps) < 0.05) < 0.75
    assert np.mean(pace([(0.2, 0.7)], 1001) == 0) == pytest.approx(0.5, abs=0.002)


def fired(rate: float, n_frames: int = 100, **keys: float) -> np.ndarray:
    sensor = SpadSensor(Sensor.model_validate(keys), (100, 100), seed=0)
    return np.array([sensor.frame(index, lambda _: np.full((100, 100), rate, np.float32)) for index in range(n_frames)])


def test_pixels_fire_again_and_trigger_their_neighbours() -> None:
    p = -np.expm1(-0.2)
    again = fired(0.2, afterpulsing=0.1)[1:]
    assert again.mean() == pytest.approx(1 - (1 - p) * (1 - 0.1 * p), abs=0.002)
    # A pixel that fired detected a photon, or fired again.
    detected = p / again.mean()
    assert again[1:][again[:-1]].mean() == pytest.approx(1 - (1 - p) * (1 - 0.1 * detected), abs=0.003)
    shared = fired(0.2, crosstalk=0.05)[:, 1:-1, 1:-1]
    assert shared.mean() == pytest.approx(1 - (1 - p) * (1 - 0.05 * p) ** 4, abs=0.002)
    single = fired(0.2, crosstalk=1.0, n_frames=1)[0]
    alone = fired(0.2, n_frames=1)[0]
    np.testing.assert_array_equal(single[1:-1, 1:-1], (alone[1:-1, 1:-1] | alone[2:, 1:-1] | alone[:-2, 1:-1]
                                                       | alone[1:-1, 2:] | alone[1:-1, :-2]))  # fmt: skip


@pytest.mark.parametrize(("rate", "dead"), [(1.0, 0.4), (0.3, 0.5), (3.0, 0.1)])
def test_dead_time_is_that_of_a_renewal_process(rate: float, dead: float) -> None:
    found = fired(rate, dead_time=dead)[1:]
    # The equation of a pixel that is blind for a time after each detection, however many frames ago.
    assert found.mean() == pytest.approx(1 - np.exp(-rate * (1 - dead)) / (1 + rate * dead), abs=0.004)
    rng, n_pixels, n_frames = np.random.default_rng(0), 4000, 100
    times = np.cumsum(dead + rng.exponential(1 / rate, (n_pixels, round(2 * n_frames * max(1, rate)))), axis=1)
    frames = np.where(times < n_frames, times, 0).astype(int)
    expected = np.zeros((n_pixels, n_frames), bool)
    np.put_along_axis(expected, frames, True, axis=1)
    expected = expected[:, 10:]
    after = expected[:, 1:][expected[:, :-1]].mean()
    assert found[1:][found[:-1]].mean() == pytest.approx(after, abs=0.015)


def test_wrong_keys_are_refused() -> None:
    with pytest.raises(ValidationError, match="its start is not before its stop; give"):
        config(shutter=[(0.5, 0.5)])
    with pytest.raises(ValidationError, match="nearest_m of 5 is above farthest_m of 4; exchange them"):
        config(clutter={"share": 0.1, "nearest_m": 5})
    with pytest.raises(ValidationError, match="which homographies from a file do not give; take another path, or objects"):
        config(path={"kind": "file", "file": "path.npy"}, people={"share": 0.1})
    with pytest.raises(InputError, match=r"path\.jumps lead off the path: .* jump less far, or later"):
        simulated(path=TURN | {"jumps": [{"at": 0.1, "by": -0.5}]})
    with pytest.raises(InputError, match=r"path\.rests leave the camera no time to move; shorten them"):
        simulated(path=TURN | {"rests": [(0, 1)]})
    with pytest.raises(InputError, match=r"boards cover at most .* raise clutter\.number, or lower clutter\.share"):
        simulated(path={"kind": "turn", "degrees": 180}, clutter={"share": 0.9, "number": 1})
