from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from photonpano import FrameSpan, SourceContext
from photonpano_simulator.config import SimulatorConfig
from photonpano_simulator.hooks import photonpano_sources

SIMULATOR, CAMERA, _ = photonpano_sources()


def problems(**settings: Any) -> list[str]:
    return list(SIMULATOR.check(SimulatorConfig.model_validate(settings)))


def test_hooks_offer_the_simulator(photo: Path) -> None:
    assert (SIMULATOR.kind, SIMULATOR.name) == ("source", "simulator")
    config = SIMULATOR.config.model_validate(
        {"scene": {"kind": "photo", "file": photo}, "path": {"kind": "hand-shake"}, "frame_shape": (40, 50)}
    )
    with SIMULATOR.build(config, SourceContext()) as source:
        assert source.counts(FrameSpan(0, 3)).shape == (40, 50)


def test_hooks_import_no_heavy_library() -> None:
    code = "import sys, photonpano_simulator.hooks; print(*sorted({'cv2', 'scipy', 'matplotlib'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_simulator_defaults_are_a_small_demo() -> None:
    config = SimulatorConfig()
    assert (config.n_frames, config.frame_shape, config.scene.kind, config.path.kind) == (2000, (254, 496), "street", "pan")
    assert problems() == []


def test_camera_simulator_defaults_are_a_small_demo() -> None:
    config = CAMERA.config()
    assert (config.n_frames, config.frame_rate_hz, config.sensor.bits) == (200, 500, 8)
    assert CAMERA.check(config) == []


def test_relative_paths_are_relative_to_the_spec(tmp_path: Path) -> None:
    config = SimulatorConfig.model_validate(
        {"scene": {"kind": "photo", "file": "a.png"}, "sensor": {"dark_rates": "b.npy"}}, context={"directory": tmp_path}
    )
    assert list(SIMULATOR.check(config)) == [
        f"there is no file {tmp_path / 'b.npy'}; check the path",
        f"there is no file {tmp_path / 'a.png'}; check the path",
    ]


def test_check_refuses_path_that_leaves_the_street() -> None:
    scene = {"kind": "street", "width": 800, "height": 600}
    assert problems(scene=scene, path={"kind": "pan", "length_px": 400, "shake": {}}, n_frames=1_000_000) == [
        "the camera path leaves the scene of 800x600 px by 49.1 px at the right, 100% of the way along; "
        "shorten or move the path, or take a larger scene"
    ]
    (problem,) = problems(path={"kind": "file", "file": "nowhere.npy"})
    assert problem == "there is no file nowhere.npy; check the path"


def test_check_refuses_dropped_frames_that_do_not_exist() -> None:
    assert problems(drops=[{"at": 1990, "frames": 20}], repeats=[{"at": 2000}]) == [
        "drops names the frames 1990 to 2009, but the camera takes 2000 frames (0 to 1999); shorten the range, "
        "or raise n_frames",
    ]
    assert problems(drops=[{"at": 0, "frames": 2000}]) == ["drops leaves none of the 2000 frames; drop fewer of them"]


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
