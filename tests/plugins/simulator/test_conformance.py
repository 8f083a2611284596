"""The source of this plugin keeps what every source promises."""

from __future__ import annotations

from photonpano import discover
from photonpano.testing import SourceConformance


class TestSimulator(SourceConformance):
    contribution = discover().find("source", "simulator").contribution
    config = {
        "scene": {"kind": "street", "width": 256, "height": 171},
        "path": {"kind": "pan", "length_px": 40, "shake": {"rms_px": 1}},
        "sensor": {"hot_fraction": 0.01, "mask_hot_pixels": True},
        "n_frames": 60,
        "frame_shape": [40, 52],
    }
    wrong = (
        {"scene": {"kind": "photo", "file": "there-is-no-such-file.png"}},
        {"path": {"kind": "file", "file": "there-is-no-such-file.npz"}},
        {"sensor": {"hot_pixels": "there-is-no-such-file.npy"}},
        {"path": {"kind": "pan", "length_px": 4000}},
    )
