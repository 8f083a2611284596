"""Every component that comes with photonpano keeps what its kind promises."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest

from photonpano import discover
from photonpano.specs import builtin
from photonpano.testing import (
    ExecutorConformance,
    ExporterConformance,
    InterpolatorConformance,
    LocatorConformance,
    MergerConformance,
    RefinerConformance,
    RendererConformance,
    ResamplerConformance,
)
from photonpano.testing.conformance import Conformance
from photonpano_poses.testing import PoseEstimatorConformance

(AUTO,) = builtin.photonpano_sources()
CATALOG = discover()
OURS = [(entry.kind, entry.name) for entry in CATALOG.rows if entry.origin.plugin == "photonpano"]


def of(kit: type[Conformance], name: str, **attributes: Any) -> type[Conformance]:
    """Return the tests of a component; `config`, tolerances and the like are attributes of its kit."""
    return type(name, (kit,), {"contribution": CATALOG.find(kit.kind, name).contribution, **attributes})


TestMidpoint = of(ResamplerConformance, "midpoint", config={"group_size": 100})
TestMidpointAuto = of(ResamplerConformance, "midpoint")
TestStratified = of(ResamplerConformance, "stratified", config={"group_size": 100})
TestStratifiedAuto = of(ResamplerConformance, "stratified")
TestSlidingWindow = of(ResamplerConformance, "sliding-window", config={"group_size": 100})
TestSlidingWindowAuto = of(ResamplerConformance, "sliding-window")
TestConstantGroups = of(ResamplerConformance, "constant-groups", config={"group_size": 100})
TestConstantGroupsAuto = of(ResamplerConformance, "constant-groups")

TestPhotonMle = of(MergerConformance, "photon-mle", config={"tolerance_px": 0.5})
TestNaiveAverage = of(MergerConformance, "photon-mle", config={"compensate": False}, compensates=False)
TestSplat = of(MergerConformance, "splat")
TestLocalFlow = of(MergerConformance, "local-flow")

TestDirect = of(LocatorConformance, "direct", tolerance_px=0.1)
TestOpencvSift = of(LocatorConformance, "opencv-sift", tolerance_px=0.3)
TestOpencvEcc = of(LocatorConformance, "opencv-ecc", tolerance_px=0.1)
TestOpencvOrb = of(LocatorConformance, "opencv-orb", tolerance_px=0.8)
TestPhaseCorrelation = of(
    LocatorConformance, "phase-correlation", tolerance_px=0.1, motions=("sub-pixel shift", "shift"), free=(4, 5)
)
TestPycolmapTwoView = of(LocatorConformance, "pycolmap-two-view", tolerance_px=0.3)
TestKorniaRegistrator = of(LocatorConformance, "kornia-registrator", tolerance_px=0.1)
TestKorniaFeatures = of(LocatorConformance, "kornia-features", config={"max_keypoints": 400}, tolerance_px=0.3)
TestKorniaFeaturesAdalam = of(
    LocatorConformance, "kornia-features", config={"max_keypoints": 200, "matcher": "adalam"}, tolerance_px=0.3
)


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write the weights of a network that has learned nothing."""
    torch = pytest.importorskip("torch")
    feature = pytest.importorskip("kornia.feature")
    path = tmp_path_factory.mktemp("weights") / "loftr.ckpt"
    with torch.random.fork_rng():
        torch.manual_seed(1)
        torch.save(feature.LoFTR(pretrained=None).state_dict(), path)
    return path


class TestKorniaLoftr(LocatorConformance):
    contribution = CATALOG.find("locator", "kornia-loftr").contribution
    motions = ()
    shape = (48, 64)

    @pytest.fixture(autouse=True)
    def weights(self, untrained: Path) -> None:
        self.config = {"weights": untrained}


TestLucasKanade = of(InterpolatorConformance, "lucas-kanade")
TestGeodesic = of(InterpolatorConformance, "geodesic")
TestSmoothingSpline = of(InterpolatorConformance, "smoothing-spline", tolerance_px=3.0)

TestShortSpans = of(RefinerConformance, "short-spans")

TestMerge = of(RendererConformance, "merge")
TestSuperResolution = of(RendererConformance, "super-resolution", scales=(2.0,))

TestExr = of(ExporterConformance, "exr")
TestHdr = of(ExporterConformance, "hdr")
TestOmeZarr = of(ExporterConformance, "ome-zarr")

TestColmapAverages = of(PoseEstimatorConformance, "colmap-averages", config={"group_size": 32})
TestStratifiedPose = of(
    PoseEstimatorConformance, "stratified-pose", config={"group_size": 32, "levels": 2}, tolerance=0.01, tolerance_deg=0.5
)

TestThreads = of(ExecutorConformance, "threads")
TestDask = pytest.mark.filterwarnings("default")(of(ExecutorConformance, "dask", config={"workers": 1}))


class TestPoses(Conformance):
    """A kind of run is no component of a spec: what holds for every contribution holds."""

    kind = "run-kind"
    contribution = CATALOG.find("run-kind", "poses").contribution


class TestAuto(Conformance):
    """It stands for the source that recognises a path; the same holds."""

    kind = "source"
    contribution = AUTO
    config = {"path": "capture.npy"}


@pytest.fixture(scope="module")
def tested() -> set[tuple[str, str]]:
    """Return kind and name of all contributions under test in a class of the kit."""
    spec = importlib.util.spec_from_file_location("conformance_of_sources", Path(__file__).with_name("test_sources.py"))
    sources = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sources)
    classes = [value for name, value in (*globals().items(), *vars(sources).items()) if name.startswith("Test")]
    return {(each.contribution.kind, each.contribution.name) for each in classes}


@pytest.mark.parametrize(("kind", "name"), OURS)
def test_own_components_have_conformance_tests(kind: str, name: str, tested: set[tuple[str, str]]) -> None:
    assert (kind, name) in tested, f"add its {kind.capitalize()}Conformance to {Path(__file__).name}, or to test_sources.py"
