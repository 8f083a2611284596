"""Captures of a camera that travels: statistics, seeds, paths, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from photonpano import FrameSpan, InputError, SourceContext
from photonpano_simulator.config import SimulatorConfig
from photonpano_simulator.hooks import photonpano_sources
from photonpano_simulator.paths import camera_path
from photonpano_simulator.travel.paths import centres
from photonpano_simulator.travel.source import TravelSource
from photonpano_simulator.travel.truth import depth, flow, read_truth, sharp_view, truth_of
from photonpano_simulator.travel_config import TravelConfig

(TRAVEL,) = (each for each in photonpano_sources() if each.name == "travel-simulator")
SMALL = {"scene": {"kind": "planes"}, "n_frames": 400, "frame_shape": (40, 52), "focal_px": 40.0}


def config(**settings: Any) -> TravelConfig:
    return TravelConfig.model_validate(SMALL | settings)


@pytest.fixture
def travelling() -> Callable[..., TravelSource]:
    def build(run_seed: int = 0, **settings: Any) -> TravelSource:
        return TravelSource(config(**settings), SourceContext(seed=run_seed))

    return build


def test_frames_are_draws_of_their_sharp_views(travelling) -> None:
    source = travelling(sensor={"dark_rate": 0.02, "gain_std": 0.1}, drift=3.0, n_frames=200)
    truth = source.truth()
    frames = source.frames(FrameSpan(0, 200)).astype(float)
    made = truth_of(truth)
    chances = np.stack([-np.expm1(-(sharp_view(made, k) * truth["gains"] + 0.02)) for k in range(200)])
    spread = np.sqrt((chances * (1 - chances)).sum())
    assert abs(frames.sum() - chances.sum()) < 4 * spread
    standard = (frames - chances) / np.sqrt(chances * (1 - chances))
    assert standard.var() == pytest.approx(1, abs=0.015)
    # Neighbouring frames are independent.
    assert abs((standard[1:] * standard[:-1]).mean()) < 4 / np.sqrt(standard[1:].size)


def test_flux_is_the_mean_along_the_path(travelling) -> None:
    made = truth_of(travelling(flux=0.7, sensor={"quantum_efficiency": 0.5}).truth())
    views = [sharp_view(made, k).mean() for k in np.linspace(0, 399, 9).astype(int)]
    assert np.mean(views) == pytest.approx(0.35, rel=1e-5)


def test_a_frame_depends_on_seed_and_index_alone(travelling) -> None:
    source, again, other = travelling(run_seed=5), travelling(seed=5), travelling(run_seed=6)
    backwards = [again.frames(FrameSpan(k, k + 1))[0] for k in (9, 3, 0)]
    np.testing.assert_array_equal(source.frames(FrameSpan(0, 10))[[9, 3, 0]], backwards)
    assert (source.frames(FrameSpan(0, 1)) != other.frames(FrameSpan(0, 1))).any()
    kept = travelling(run_seed=5, drops=[{"at": 2, "frames": 3}])
    np.testing.assert_array_equal(kept.frames(FrameSpan(2, 3)), source.frames(FrameSpan(5, 6)))
    assert kept.truth()["taken"][:4].tolist() == [0, 1, 5, 6]


def test_scenes_depend_on_their_seeds(travelling) -> None:
    views = [sharp_view(truth_of(travelling(scene={"kind": "planes", "seed": seed}).truth()), 0) for seed in (0, 0, 1)]
    np.testing.assert_array_equal(views[0], views[1])
    assert np.abs(views[0] - views[2]).mean() > 0.02


def test_path_has_its_length_and_tremor(travelling) -> None:
    still = travelling(path={"kind": "travel", "length_m": 0.4, "centre": (0.1, 0, -0.2)}).truth()["camera_from_world"]
    tremor = {"rms_px": 2.0, "rms_mm": 3.0, "roll_rms_deg": 0.5, "frequencies_hz": (500, 900, 1300)}
    shaken = travelling(path={"kind": "travel", "length_m": 0.4, "centre": (0.1, 0, -0.2), "tremor": tremor})
    shaken = shaken.truth()["camera_from_world"]
    way = centres(still)
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).sum() == pytest.approx(0.4, rel=1e-3)
    np.testing.assert_allclose((way.min(axis=0) + way.max(axis=0)) / 2, (0.1, 0, -0.2), atol=1e-3)
    np.testing.assert_allclose(
        still[:, :, :3] @ np.swapaxes(still[:, :, :3], 1, 2), np.broadcast_to(np.eye(3), (400, 3, 3)), atol=1e-12
    )
    assert np.sqrt(((centres(shaken) - way) ** 2).mean(axis=0)) == pytest.approx([0.003] * 3, rel=0.05)
    small = shaken[:, :, :3] @ np.swapaxes(still[:, :, :3], 1, 2)
    assert np.sqrt((small[:, 0, 2] ** 2).mean()) == pytest.approx(2 / 40, rel=0.05)
    assert np.sqrt((small[:, 0, 1] ** 2).mean()) == pytest.approx(np.deg2rad(0.5), rel=0.1)


def test_turn_only_has_no_parallax(travelling) -> None:
    made = truth_of(travelling(path={"kind": "turn-only", "degrees": 20}).truth())
    assert np.ptp(centres(made.camera_from_world), axis=0).max() < 1e-12
    first, last = made.camera_from_world[[0, -1], :, :3]
    turn = last @ first.T
    homography = made.camera_matrix @ turn @ np.linalg.inv(made.camera_matrix)
    x, y, w = homography @ (30, 20, 1)
    np.testing.assert_allclose(flow(made, 0, 399).vectors[20, 30], (x / w - 30, y / w - 20), atol=1e-9)
    # To the right: what is seen goes left, by 20 degrees.
    assert x / w < 30 - 10
    assert np.arccos((np.trace(turn) - 1) / 2) == pytest.approx(np.deg2rad(20))


def test_objects_are_where_they_should_be(travelling) -> None:
    thing = {"shape": "disc", "size": (0.5, 0.5), "at": (0.5, 0.5), "distance_m": 1.0, "moves_px": (0.02, -0.01), "flux": 2.0}
    made = truth_of(travelling(path={"kind": "turn-only", "degrees": 0}, objects=[thing]).truth())
    near = depth(made, 0) < 1.5
    assert np.allclose(depth(made, 0)[near], 1.0)
    # A disc as high as half the frame.
    assert near.sum() == pytest.approx(np.pi * 10**2, rel=0.05)
    np.testing.assert_allclose(flow(made, 0, 300).vectors[20, 26], (6, -3), atol=1e-9)
    view = sharp_view(made, 0)
    assert view[near].mean() == pytest.approx(2 * 0.3, rel=0.25)


def test_truth_files_are_read(travelling, tmp_path: Path) -> None:
    source = travelling(drops=[{"at": 0, "frames": 100}])
    np.savez(tmp_path / "a.truth.npz", **source.truth())
    made = read_truth(tmp_path / "a.truth.npz")
    np.testing.assert_array_equal(sharp_view(made, 7), sharp_view(truth_of(source.truth()), 7))
    assert depth(made, 7).shape == (40, 52)
    with pytest.raises(InputError, match=r"there is no frame 300; the capture has the frames 0 to 299"):
        depth(made, 300)
    np.savez(tmp_path / "b.npz", homographies=np.eye(3)[None])
    with pytest.raises(InputError, match=r"b\.npz is the truth of a scene without depth: it lacks camera_from_world"):
        read_truth(tmp_path / "b.npz")


@pytest.mark.parametrize("kind", ["room", "facade"])
def test_other_scenes_are_placed_around_the_camera(kind: str) -> None:
    for seed in range(3):
        assert TRAVEL.check(config(scene={"kind": kind, "seed": seed})) == []


def test_photograph_is_hung_in_the_scene(travelling, tmp_path: Path) -> None:
    image = np.zeros((60, 90), np.uint8)
    image[:, 45:] = 200
    cv2.imwrite(str(tmp_path / "a.png"), image)
    texels = travelling(scene={"kind": "planes", "photo": tmp_path / "a.png"}).truth()["textures"]
    _, counts = np.unique(texels, return_counts=True)
    assert counts[np.argsort(counts)[-2:]].sum() > 0.9 * texels.size


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (
            {"scene": {"kind": "room"}, "path": {"kind": "travel", "centre": (0, 0, 5)}},
            "the camera leaves the scene: it is at (-0.08, -0.04, 4.97) m, 0% of the way along, and may be between "
            "(-2.5, -1.1, -1.8) and (2.5, 1.5, 4.2) m; move path.centre, or shorten the path",
        ),
        (
            {"scene": {"kind": "room"}, "path": {"kind": "travel", "centre": (0.3, 0.75, 2.5), "length_m": 1.5}},
            "the path of the camera passes through a surface of the scene at (0.03, 0.76, 2.46) m, 9% of the way along; "
            "move path.centre, or shorten path.length_m",
        ),
        (
            {"path": {"kind": "turn-only", "degrees": 180}},
            "the camera sees past the end of the scene 0% of the way along: there is nothing at the pixel (0, 0); "
            "move path.look_at to the middle of the scene, or turn by less",
        ),
        (
            {"path": {"kind": "turn-only", "look_at": (0, -3, 0)}},
            "the camera cannot look at (0.00, -3.00, 0.00) m: on its path that is where it is, or straight above or below it; "
            "move path.look_at",
        ),
        (
            {"drops": [{"at": 390, "frames": 20}]},
            "drops names the frames 390 to 409, but the camera takes 400 frames (0 to 399); "
            "shorten the range, or raise n_frames",
        ),
    ],
)
def test_wrong_paths_are_refused_before_anything_is_drawn(settings: dict[str, Any], expected: str) -> None:
    assert list(TRAVEL.check(config(**settings))) == [expected]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"focal_px": 5}, "focal_px of 5 does not fit frames 52 px wide; take 13 to 5200 px"),
        ({"focal_px": 9000}, "focal_px of 9000 does not fit frames 52 px wide; take 13 to 5200 px"),
        ({"centre_px": (60, 20)}, "lies outside the frame of 52x40 px"),
        ({"sensor": {"filters": "rggb"}}, "scenes with depth are grey"),
        ({"path": {"kind": "travel", "degrees": 3}}, "Extra inputs"),
        ({"objects": [{"distance_m": 0}]}, "greater than or equal to 0.2"),
    ],
)
def test_values_out_of_range_are_refused(settings: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValidationError, match=expected):
        config(**settings)


def test_homographies_of_a_scene_with_depth_are_refused(travelling, tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **travelling(n_frames=5).truth())
    path = {"kind": "file", "file": tmp_path / "a.npz"}
    with pytest.raises(InputError, match=r"a\.npz is the truth of a scene with depth, which has no homographies; take that of"):
        camera_path(SimulatorConfig.model_validate({"path": path, "n_frames": 5}), (1365, 2048), seed=0)
