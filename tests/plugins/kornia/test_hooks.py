"""How the plugin is listed, with and without its libraries."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from photonpano import SpecError, StreamInfo, discover, parse_spec
from photonpano.cli.app import app
from photonpano_kornia.configs import KorniaLoftrConfig

NAMES = ("kornia-features", "kornia-loftr", "kornia-registrator")


@pytest.fixture
def not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name in {"torch", "kornia"} else find(name, *rest)
    )


@pytest.mark.usefixtures("not_installed")
def test_locator_is_listed_with_install_hint_if_library_is_missing() -> None:
    shown = CliRunner().invoke(app, ["plugins", "list", "--kind", "locator"], prog_name="photonpano").stdout
    for name in NAMES:
        assert re.search(rf"^locator +{name} .*\[not installed: photonpano\[kornia\]\]", shown, re.MULTILINE), shown
    unavailable = discover().find("locator", NAMES[0]).unavailable or ""
    assert 'needs kornia, which is not installed: pip install "photonpano[kornia]"' in unavailable


@pytest.mark.usefixtures("not_installed")
def test_spec_with_locator_is_rejected_if_library_is_missing() -> None:
    with pytest.raises(SpecError, match="pip install"):
        parse_spec({"version": 1, "source": {"use": "simulator"}, "locate": {"use": NAMES[0]}})


def test_missing_weights_are_a_problem_of_the_spec(tmp_path: Path) -> None:
    contribution = discover().find("locator", "kornia-loftr").contribution
    stream = StreamInfo(100, 64, 96, frame_rate_hz=None)
    weights = tmp_path / "loftr.ckpt"
    config = contribution.config(weights=weights)
    assert contribution.check(config, stream) == (
        f"there is no file {weights} with weights of LoFTR, and nothing is downloaded: set `weights` to your file",
    )
    weights.touch()
    assert contribution.check(config, stream) == ()


def test_path_of_weights_is_relative_to_folder_of_spec(tmp_path: Path) -> None:
    config = KorniaLoftrConfig.model_validate({"weights": "loftr.ckpt"}, context={"directory": tmp_path})
    assert config.weights == tmp_path / "loftr.ckpt"
