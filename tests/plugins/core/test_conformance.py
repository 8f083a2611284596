"""Conformance tests of the components of this plugin."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from photonpano import discover
from photonpano.testing import (
    ExecutorConformance,
    ExporterConformance,
    InterpolatorConformance,
    MergerConformance,
    RefinerConformance,
    RendererConformance,
    ResamplerConformance,
    SourceConformance,
)

CATALOG = discover()


class TestPackedNpy(SourceConformance):
    contribution = CATALOG.find("source", "packed-npy").contribution
    wrong = ({"path": "there-is-no-such-file.npy"}, {"width": 33})

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        np.save(folder / "capture.npy", np.packbits(frames, axis=-1))
        return {"path": folder / "capture.npy", "width": frames.shape[2]}


class TestPackedRaw(SourceConformance):
    contribution = CATALOG.find("source", "packed-raw").contribution
    config = {"height": 18, "width": 27, "bit_order": "little", "header_bytes": 5}
    wrong = ({"path": "there-is-no-such-file.raw"}, {"height": 1000}, {"header_bytes": 4})

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        packed = np.packbits(frames, axis=-1, bitorder="little")
        (folder / "capture.raw").write_bytes(b"12345" + packed.tobytes())
        return {"path": folder / "capture.raw"}


class TestNpyBits(SourceConformance):
    contribution = CATALOG.find("source", "npy").contribution
    config = {"holds": "bits"}
    wrong = ({"path": "there-is-no-such-file.npy"},)

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        np.save(folder / "capture.npy", frames.astype(bool))
        return {"path": folder / "capture.npy"}


class TestNpyBitsFramesLast(TestNpyBits):
    grows = False
    config = {"holds": "bits", "frame_axis": "last"}

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        np.save(folder / "capture.npy", np.ascontiguousarray(np.moveaxis(frames * np.uint8(255), 0, -1)))
        return {"path": folder / "capture.npy"}


class TestNpySums(SourceConformance):
    contribution = CATALOG.find("source", "npy").contribution
    config = {"holds": "sums", "frames_per_sum": 1023}
    bit_depth = 10
    wrong = ({"path": "there-is-no-such-file.npy"},)

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        np.save(folder / "capture.npy", frames.astype(">i8"))
        return {"path": folder / "capture.npy"}


class TestNpySumsFramesLast(TestNpySums):
    grows = False
    config = {"holds": "sums", "frames_per_sum": 1023, "frame_axis": "last"}

    def write(self, frames: np.ndarray, folder: Path) -> dict[str, Any]:
        np.save(folder / "capture.npy", np.ascontiguousarray(np.moveaxis(frames, 0, -1)))
        return {"path": folder / "capture.npy"}


class TestMidpoint(ResamplerConformance):
    contribution = CATALOG.find("resampler", "midpoint").contribution
    config = {"group_size": 100}


class TestMidpointAuto(TestMidpoint):
    config = {}


class TestStratified(ResamplerConformance):
    contribution = CATALOG.find("resampler", "stratified").contribution
    config = {"group_size": 100}


class TestStratifiedAuto(TestStratified):
    config = {}


class TestSlidingWindow(ResamplerConformance):
    contribution = CATALOG.find("resampler", "sliding-window").contribution
    config = {"group_size": 100}


class TestSlidingWindowAuto(TestSlidingWindow):
    config = {}


class TestConstantGroups(ResamplerConformance):
    contribution = CATALOG.find("resampler", "constant-groups").contribution
    config = {"group_size": 100}


class TestConstantGroupsAuto(TestConstantGroups):
    config = {}


class TestPhotonMle(MergerConformance):
    contribution = CATALOG.find("merger", "photon-mle").contribution
    config = {"tolerance_px": 0.5}


class TestNaiveAverage(TestPhotonMle):
    config = {"compensate": False}
    compensates = False


class TestRobustMerge(MergerConformance):
    contribution = CATALOG.find("merger", "robust-merge").contribution


class TestSplat(MergerConformance):
    contribution = CATALOG.find("merger", "splat").contribution


class TestLocalFlow(MergerConformance):
    contribution = CATALOG.find("merger", "local-flow").contribution


class TestBurst(MergerConformance):
    contribution = CATALOG.find("merger", "burst").contribution
    # It finds the motion by itself, as well as patches of 40x56 px allow.
    compensates = False


class TestLucasKanade(InterpolatorConformance):
    contribution = CATALOG.find("interpolator", "lucas-kanade").contribution


class TestGeodesic(InterpolatorConformance):
    contribution = CATALOG.find("interpolator", "geodesic").contribution


class TestLie(InterpolatorConformance):
    contribution = CATALOG.find("interpolator", "lie").contribution


class TestSmoothingSpline(InterpolatorConformance):
    contribution = CATALOG.find("interpolator", "smoothing-spline").contribution
    tolerance_px = 3.0


class TestShortSpans(RefinerConformance):
    contribution = CATALOG.find("refiner", "short-spans").contribution


class TestMerge(RendererConformance):
    contribution = CATALOG.find("renderer", "merge").contribution


class TestSuperResolution(RendererConformance):
    contribution = CATALOG.find("renderer", "super-resolution").contribution
    scales = (2.0,)


class TestExr(ExporterConformance):
    contribution = CATALOG.find("exporter", "exr").contribution


class TestHdr(ExporterConformance):
    contribution = CATALOG.find("exporter", "hdr").contribution


class TestThreads(ExecutorConformance):
    contribution = CATALOG.find("executor", "threads").contribution
