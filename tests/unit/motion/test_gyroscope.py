"""A gyroscope: its file, the rotations by its rates, and the pairs that these tie, with their expected error."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from photonpano import FrameSpan, Group, InputError, Located
from photonpano.geometry import Camera, corner_displacements, right_handed_axes, rotation_matrices, rotation_vectors
from photonpano.motion.graph import solve
from photonpano.motion.gyroscope import Gyroscope, Rates, read_rates
from photonpano.motion.models import MotionModel
from photonpano.motion.pairs import GYROSCOPE
from photonpano.testing import measured_rates

SHAPE, FOCAL_PX = (64, 96), 122.0
HEADER = "t_s,wx_rad_s,wy_rad_s,wz_rad_s\n"
COLUMNS = (
    "the first line must name the columns t_s, wx_rad_s, wy_rad_s, wz_rad_s, or wx_deg_s, wy_deg_s, wz_deg_s for degrees; "
    "it is "
)
NUMBERS = "expected a number for each of t_s, wx_rad_s, wy_rad_s, wz_rad_s"
SAMPLES = "".join(f"{time},0,0,0\n" for time in range(4))
GROUPS = [Group(FrameSpan(start, start + 50), start + 24.5) for start in range(0, 1000, 50)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", COLUMNS + "''"),
        ("t,wx,wy,wz\n" + SAMPLES, COLUMNS + "'t,wx,wy,wz'"),
        ("t_s,wx_rad_s,wy_rad_s,wz_deg_s\n" + SAMPLES, COLUMNS + "'t_s,wx_rad_s,wy_rad_s,wz_deg_s'"),
        (HEADER, "must hold at least 4 samples, and no NaN or infinite numbers"),
        (HEADER + "1,2,here,4\n", f", line 2: {NUMBERS}, got '1,2,here,4'"),
        (HEADER + SAMPLES + "\n1,2,3\n", f", line 7: {NUMBERS}, got '1,2,3'"),
        (HEADER + "0,0,0,0\n", "must hold at least 4 samples, and no NaN or infinite numbers"),
        (HEADER + SAMPLES + "4,nan,0,0\n", "must hold at least 4 samples, and no NaN or infinite numbers"),
        (HEADER + SAMPLES + "2,0,0,0\n", "2 s follows 3 s; sort its lines by time"),
        (
            HEADER + SAMPLES + "4,0,60,0\n",
            "holds rates up to 60 rad/s, more than any usual gyroscope measures; if they are in deg/s, name the columns "
            "wx_deg_s, wy_deg_s, wz_deg_s",
        ),
    ],
)  # fmt: skip
def test_wrong_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (file := tmp_path / "imu.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        read_rates(file)
    assert str(caught.value).removeprefix(str(file)).removeprefix(":").strip() == message


def test_rates_in_degrees_without_their_bias_are_the_rotations(tmp_path: Path) -> None:
    frames = np.arange(1000)[:, None] / 1000
    truth = rotation_matrices(np.sin(frames * [3.0, 2.0, 5.0]) * [0.1, 0.5, 0.2])
    (file := tmp_path / "imu.csv").write_text(
        measured_rates(truth, 1000.0, bias_deg_s=(1, -2, 3), offset_s=5.0, noise_deg_s_sqrt_hz=0.0)
    )
    found = read_rates(file).rotations(frames[:, 0] + 5, np.deg2rad([1, -2, 3]))
    away = np.swapaxes(truth, -1, -2) @ truth[0] @ found
    assert np.abs(rotation_vectors(away)).max() < 2e-5


def test_axes_are_the_24_rotations() -> None:
    axes = right_handed_axes()
    assert len(axes) == 24
    assert axes["x, -y, -z"].tolist() == np.diag([1, -1, -1]).tolist()
    assert "x, y, -z" not in axes
    rates = Rates(Path("imu.csv"), np.arange(2.0), np.array([[1.0, 2.0, 3.0]] * 2))
    assert rates.about(axes["y, -x, z"]).rad_s[0].tolist() == [2, -1, 3]


def gyroscope_of(rad_s: np.ndarray, noise: float = 0.0, std_bias: float = 0.0) -> Gyroscope:
    times_s = np.arange(0, 1.001, 0.001)
    rates = Rates(Path("imu.csv"), times_s, np.broadcast_to(rad_s, (len(times_s), 3)))
    camera, frames_s = Camera.of(FOCAL_PX, SHAPE), np.arange(1000) / 1000
    return Gyroscope(
        rates=rates,
        camera=camera,
        frame_shape=SHAPE,
        frames_s=frames_s,
        noise=noise,
        bias_rad_s=np.zeros(3),
        std_bias_rad_s=np.full(3, std_bias),
        std_offset_s=0.0,
    )


def test_pairs_of_a_still_camera_scatter_as_expected() -> None:
    noise, std_bias, rng = np.deg2rad(0.05), np.deg2rad(0.2), np.random.default_rng(4)
    squares, ends, camera = [], [], Camera.of(FOCAL_PX, SHAPE)
    for _ in range(60):
        drift = rng.normal(0, noise * np.sqrt(1000), (1001, 3))
        edges = gyroscope_of(drift, noise).edges(GROUPS)
        motions = np.array([edge.motion.homography for edge in edges])
        squares.append(np.mean(corner_displacements(motions, np.eye(3), SHAPE) ** 2))
        biased = gyroscope_of(drift + rng.normal(0, std_bias, 3), noise, std_bias).edges(GROUPS)
        turned = rotation_vectors(camera.rotations(np.array([edge.motion.homography for edge in biased])))
        ends.append(np.sum(turned.sum(axis=0) ** 2))
    expected = np.mean([edge.motion.evidence["std_px"] ** 2 for edge in edges])
    assert np.mean(squares) == pytest.approx(expected, rel=0.1)
    # Over the whole capture, a bias leads as far as the random walk that stands for it.
    walked = gyroscope_of(np.zeros(3), noise, std_bias).edges(GROUPS)
    variance = sum(edge.motion.evidence["std_px"] ** 2 for edge in walked) / expected * (noise**2 * 0.05) * 3
    assert np.mean(ends) == pytest.approx(variance, rel=0.3)
    assert [(edge.moving, edge.fixed, edge.locator) for edge in edges[:2]] == [(1, 0, GYROSCOPE), (2, 1, GYROSCOPE)]


def test_a_graph_of_the_gyroscope_alone_drifts_by_its_expected_error() -> None:
    """By 0.3 px for each pair, as of a random walk."""
    gyroscope = gyroscope_of(np.array([0.1, 0.6, -0.2]), np.deg2rad(0.01), np.deg2rad(0.3))
    edges, model = gyroscope.edges(GROUPS), MotionModel(kind="rotation", focal_px=FOCAL_PX)
    std_px = solve(GROUPS, edges, len(GROUPS) // 2, frame_shape=SHAPE, start=None, model=model).assess().std_px
    assert isinstance(edges[0].motion, Located)
    of_pair = edges[0].motion.evidence["std_px"]
    # From the mean of 20 places of a walk, its ends are sqrt(20 / 3) steps away.
    assert std_px[[0, -1]] == pytest.approx(of_pair * np.sqrt(20 / 3), rel=0.3)


def test_an_axis_that_turns_the_other_way_is_named() -> None:
    """Alone, it differs by less than what is refused."""
    times_s, model = np.arange(0, 1.001, 0.001)[:, None], MotionModel(kind="rotation", focal_px=FOCAL_PX)
    turning = np.hstack([0.1 + 0 * times_s, 0.6 + 0 * times_s, 0.05 * np.sin(9 * times_s)])
    seen = [replace(edge, locator="direct") for edge in gyroscope_of(turning, np.deg2rad(0.01)).edges(GROUPS)]
    for sign in (1, -1):
        other = gyroscope_of(turning * [1, 1, sign], np.deg2rad(0.5), np.deg2rad(1))
        edges = (*seen, *other.edges(GROUPS))
        located = solve(GROUPS, seen, 0, frame_shape=SHAPE, start=None, model=model)
        if sign > 0:
            other.agreement(edges, located, 0.05)
        else:
            with pytest.raises(InputError, match=r"about the axis z of the camera, pairs of exposures turn 1 times as far"):
                other.agreement(edges, located, 0.05)


def test_rates_that_contradict_the_images_are_refused() -> None:
    seen, other = gyroscope_of(np.array([0.1, 0.6, 0.0])), gyroscope_of(np.array([0.3, -0.4, 0.0]), np.deg2rad(0.01))
    located = solve(
        GROUPS, seen.edges(GROUPS), 0, frame_shape=SHAPE, start=None, model=MotionModel(kind="rotation", focal_px=FOCAL_PX)
    )
    assert all(isinstance(edge.motion, Located) for edge in other.edges(GROUPS))
    with pytest.raises(
        InputError, match=r"imu.csv: the rates contradict the images by \d\.?\d* px from one exposure to the next"
    ):
        other.agreement(other.edges(GROUPS), located, 0.05)
