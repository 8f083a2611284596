"""The locators of this plugin keep what every locator promises."""

from __future__ import annotations

from pathlib import Path

import pytest

from photonpano import discover
from photonpano.testing import LocatorConformance

CATALOG = discover()


class TestKorniaRegistrator(LocatorConformance):
    contribution = CATALOG.find("locator", "kornia-registrator").contribution
    tolerance_px = 0.1


class TestKorniaFeatures(LocatorConformance):
    contribution = CATALOG.find("locator", "kornia-features").contribution
    config = {"max_keypoints": 400}
    tolerance_px = 0.3


class TestKorniaFeaturesAdalam(TestKorniaFeatures):
    config = {"max_keypoints": 400, "matcher": "adalam"}


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
