"""The source of this plugin keeps what every source promises."""

from __future__ import annotations

from photonpano import discover
from photonpano.testing import SourceConformance

CATALOG = discover()
SMALL = {"scene": {"kind": "street", "width": 256, "height": 171}, "n_frames": 60, "frame_shape": [40, 52]}


class TestSimulator(SourceConformance):
    contribution = CATALOG.find("source", "simulator").contribution
    config = {
        **SMALL,
        "path": {"kind": "pan", "length_px": 40, "shake": {"rms_px": 1}},
        "sensor": {"hot_fraction": 0.01, "mask_hot_pixels": True},
    }
    wrong = (
        {"scene": {"kind": "photo", "file": "there-is-no-such-file.png"}},
        {"path": {"kind": "file", "file": "there-is-no-such-file.npz"}},
        {"sensor": {"hot_pixels": "there-is-no-such-file.npy"}},
        {"path": {"kind": "pan", "length_px": 4000}},
    )


class TestDisturbedSimulator(SourceConformance):
    contribution = CATALOG.find("source", "simulator").contribution
    config = {
        **SMALL,
        "path": {"kind": "pan", "length_px": 40},
        "lens": {"k1": -0.05, "vignette": 0.5},
        "objects": [{"size": [0.3, 0.5], "moves_px": [0.5, 0]}],
        "drops": [{"at": 20, "frames": 5}],
        "repeats": [{"at": 40, "frames": 3}],
        "sensor": {"gain_std": 0.05, "dirt": {}},
        "drift": 0.5,
    }
    wrong = ({"drops": [{"at": 50, "frames": 20}]},)


class TestConventionalCamera(SourceConformance):
    contribution = CATALOG.find("source", "camera-simulator").contribution
    config = {**SMALL, "path": {"kind": "pan", "length_px": 90}, "sensor": {"exposure": 0.5}}
    wrong = ({"path": {"kind": "pan", "length_px": 4000}},)


class TestConventionalCameraOf12Bits(TestConventionalCamera):
    config = {**TestConventionalCamera.config, "sensor": {"bits": 12}}


class TestTravelSimulator(SourceConformance):
    contribution = CATALOG.find("source", "travel-simulator").contribution
    config = {
        "scene": {"kind": "planes"},
        "path": {"kind": "travel", "length_m": 0.3, "tremor": {"rms_px": 1}},
        "objects": [{"shape": "disc", "moves_px": [0.2, 0]}],
        "n_frames": 60,
        "frame_shape": [40, 52],
        "focal_px": 40,
        "drops": [{"at": 20, "frames": 5}],
        "sensor": {"hot_fraction": 0.01, "mask_hot_pixels": True},
    }
    wrong = (
        {"scene": {"kind": "room", "photo": "there-is-no-such-file.png"}},
        {"path": {"kind": "travel", "length_m": 40}},
        {"path": {"kind": "turn-only", "degrees": 200}},
        {"drops": [{"at": 50, "frames": 20}]},
        {"sensor": {"hot_pixels": "there-is-no-such-file.npy"}},
    )
