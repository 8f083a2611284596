"""Odd truths and run folders: each gets a finite score, or is refused with one sentence that names the file."""

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano import PhotonpanoError, evaluate
from photonpano.evaluation import load_truth
from photonpano.geometry import corners, normalised, transform_points

OUTCOMES = Path(__file__).with_suffix(".txt")  # what becomes of each: `NAME -> SENTENCE`, or `NAME -> a score`
N_FRAMES = 120

Change = Callable[[SimpleNamespace], Any]


def true(name: str, change: Callable[[np.ndarray], Any]) -> Change:
    """Return what changes an array of the truth."""
    return lambda capture: capture.true.update({name: change(capture.true[name])})


def found(name: str, change: Callable[[np.ndarray], Any]) -> Change:
    """Return what changes an array of trajectory.npz."""
    return lambda capture: capture.trajectory.update({name: change(capture.trajectory[name])})


def image(name: str, change: Callable[[np.ndarray], Any]) -> Change:
    """Return what changes the flux or the weight of the panorama."""
    return lambda capture: setattr(capture, name, change(getattr(capture, name)))


def late(change: Change) -> Change:
    """Return what changes files after they are written."""
    return lambda capture: setattr(capture, "late", lambda: change(capture))


def written(name: str, content: str | bytes) -> Change:
    """Return what writes a file of the run folder, after the others."""
    data = content.encode() if isinstance(content, str) else content
    return late(lambda capture: (capture.folder / name).write_bytes(data))


def truth_file(change: Callable[[bytes], bytes]) -> Change:
    return late(lambda capture: capture.truth.write_bytes(change(capture.truth.read_bytes())))


def of_depth(capture: SimpleNamespace) -> None:
    capture.true["camera_from_world"] = np.zeros((N_FRAMES, 3, 4))
    del capture.true["homographies"]


def holed(value: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return what gives one number another value."""

    def change(values: np.ndarray) -> np.ndarray:
        values = values.astype(np.result_type(values, np.float32))
        values[len(values) // 2] = value
        return values

    return change


HOMOGRAPHIES: Mapping[str, Callable[[np.ndarray], Any]] = {
    "one NaN": holed(np.nan),
    "one of zeros": holed(0),
    "turned inside out": lambda values: -values,
    "all alike": lambda values: np.broadcast_to(values[:1], values.shape),
    "complex": lambda values: values + 0j,
    "words": lambda values: values.astype(str),
    "none": lambda values: values[:0],
    "one frame": lambda values: values[:1],
    "two dimensions": lambda values: values.reshape(N_FRAMES, 9),
}
CASES: Mapping[str, Change] = {
    **{f"truth, homographies: {name}": true("homographies", change) for name, change in HOMOGRAPHIES.items()},
    **{
        f"run, homographies: {name}": found("homographies", HOMOGRAPHIES[name])
        for name in ("one NaN", "words", "none", "one frame")
    },
    "truth, frame_shape: words": true("frame_shape", lambda _: np.array(["60", "90"])),
    "truth, scene: one NaN": true("scene", holed(np.nan)),
    "truth, scene: infinite": true("scene", lambda values: values * np.inf),
    "truth, scene: below zero": true("scene", lambda values: -values),
    "truth, scene: no pixel": true("scene", lambda values: values[:0]),
    "run, canvas: NaN": found("canvas", holed(np.nan)),
    "run, canvas: far away": found("canvas", lambda values: values + 1e9 * np.eye(3)[[2, 1, 1]] * [0, 0, 1]),
    "run, located: one": found("located", lambda values: np.arange(len(values)) == 7),
    "run, std_px: NaN": found("std_px", holed(np.nan)),
    "run, std_px: below zero": found("std_px", lambda values: -values),
    "run, std_px: fewer": found("std_px", lambda values: values[:7]),
    "run, frame_shape: others": found("frame_shape", lambda values: values[::-1]),
    "panorama: NaN": image("flux", lambda values: values * np.nan),
    "panorama: below zero": image("flux", lambda values: -values),
    "panorama: one row": image("flux", lambda values: values[:1]),
    "coverage: below zero": image("weight", lambda values: -values),
    **{
        f"run.json: {name}": written("run.json", content)
        for name, content in {
            "empty": "",
            "null": "null",
            "no keys": "{}",
            "no UTF-8": b'{"photonpano": "\xff"}',
            "a spec of a list": '{"photonpano": "0", "spec": [], "files": {}}',
            "files without hashes": '{"photonpano": "0", "spec": {}, "files": {"trajectory.npz": {}}}',
            "files elsewhere": '{"photonpano": "0", "spec": {}, "files": {"../truth.npz": {"bytes": 1, "sha256": "0"}}}',
        }.items()
    },
    "trajectory.npz: text": written("trajectory.npz", "frames"),
    "panorama.tiff: endless": written("panorama.tiff", b"II*\0\x08\0\0\0" + bytes(2) + b"\x08\0\0\0"),
    "coverage.tiff: cut": late(
        lambda capture: (capture.folder / "coverage.tiff").write_bytes((capture.folder / "panorama.tiff").read_bytes()[:500])
    ),
    "run: missing": late(lambda capture: setattr(capture, "folder", capture.folder / "nowhere")),
    "trajectory.npz: missing": late(lambda capture: (capture.folder / "trajectory.npz").unlink()),
    "coverage.tiff: missing": late(lambda capture: (capture.folder / "coverage.tiff").unlink()),
    "run, located: none": found("located", lambda values: values & False),
    "truth: missing": late(lambda capture: capture.truth.unlink()),
    "truth: without homographies": lambda capture: capture.true.pop("homographies"),
    "truth: of a scene with depth": of_depth,
    "truth: cut": truth_file(lambda content: content[:-200]),
    "truth: a wrong byte": truth_file(lambda content: content[:1000] + bytes([content[1000] ^ 0xFF]) + content[1001:]),
    "truth, frame_shape: no width": true("frame_shape", lambda _: np.array([60, 0])),
    "truth, undistorted_corners: three": lambda capture: capture.true.update(undistorted_corners=np.zeros((3, 2))),
    "run, camera_matrix: alone": lambda capture: capture.trajectory.update(camera_matrix=np.diag([80.0, 80, 1])),
    "run, distortion: three numbers": lambda capture: capture.trajectory.update(
        camera_matrix=np.eye(3), distortion=np.zeros(3)
    ),
}


def numbers_of(value: Any) -> list[float]:
    if isinstance(value, dict):
        return [number for each in value.values() for number in numbers_of(each)]
    if isinstance(value, list | tuple):
        return [number for each in value for number in numbers_of(each)]
    return [value] if isinstance(value, float) else []


def expected() -> dict[str, str]:
    return dict(line.split(" -> ", 1) for line in OUTCOMES.read_text(encoding="utf-8").splitlines())


def test_every_case_has_an_outcome() -> None:
    assert list(expected()) == list(CASES)


@pytest.mark.parametrize("name", CASES)
def test_odd_file_gets_a_score_or_one_sentence(name: str, capture: SimpleNamespace) -> None:
    CASES[name](capture)
    capture.write()
    getattr(capture, "late", lambda: None)()
    try:
        score = evaluate(capture.folder, capture.truth, oracle=False)
        ended = "a score"
        assert not any(math.isnan(number) for number in numbers_of(asdict(score)))
    except PhotonpanoError as error:
        ended = str(error).replace(str(capture.truth.parent), "DIR")
    assert ended == expected()[name]


def test_load_truth_returns_written_arrays(capture: SimpleNamespace) -> None:
    truth = load_truth(capture.truth)
    np.testing.assert_array_equal(truth.homographies, capture.true["homographies"])
    np.testing.assert_array_equal(truth.scene, capture.true["scene"])
    assert truth.frame_shape == (60, 90)


def test_run_on_distorted_frames_is_right_where_it_moves_the_corners_as_they_appear(
    capture: SimpleNamespace,
) -> None:
    """A corner of a barrel of 3 % shows what an ideal lens images 1 / 0.97 times as far from the middle."""
    middle, corner = np.array([44.5, 29.5]), np.array([89.0, 59.0])
    capture.true["undistorted_corners"] = middle + (corners((60, 90)) - middle) / 0.97
    capture.write()
    assert evaluate(capture.folder, capture.truth, oracle=False).trajectory.mean_px > 0.1
    truth = load_truth(capture.truth)
    expected = transform_points(capture.true["homographies"], [middle, middle + (corner - middle) / 0.97])
    np.testing.assert_allclose(transform_points(truth.homographies, [middle, corner]), expected)
    capture.trajectory["homographies"] = normalised(capture.gauge @ truth.homographies)
    capture.write()
    assert evaluate(capture.folder, capture.truth, oracle=False).trajectory.max_px < 1e-6
