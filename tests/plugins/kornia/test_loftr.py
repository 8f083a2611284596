from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from photonpano import InputError, Located, NotLocated, StreamInfo, discover
from photonpano.geometry import corner_displacements, from_parameters, transform_points

pytest.importorskip("torch")
pytest.importorskip("kornia")

import kornia
import torch

from photonpano_kornia.hooks import KorniaLoftrConfig
from photonpano_kornia.locators import LoftrLocator, loftr_from

SHAPE = (120, 176)
STILL = np.eye(3)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    """Weights of an untrained network."""
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return kornia.feature.LoFTR(pretrained=None).state_dict()


@pytest.fixture(scope="module")
def file(weights: dict[str, torch.Tensor], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("weights") / "loftr.ckpt"
    torch.save({"state_dict": {f"matcher.{name}": tensor for name, tensor in weights.items()}, "epoch": 3}, path)
    return path


@pytest.fixture(scope="module")
def build(file: Path) -> Callable[..., LoftrLocator]:
    return lambda **config: LoftrLocator(KorniaLoftrConfig(weights=file, **config), seed=0)


def test_loftr_from_loads_weights_and_keeps_generator_state(
    weights: dict[str, torch.Tensor], file: Path, tmp_path: Path
) -> None:
    """From a checkpoint of the authors, and from bare tensors."""
    bare = tmp_path / "bare.pt"
    torch.save(weights, bare)
    before = torch.get_rng_state()
    for path in (file, bare):
        network = loftr_from(path, CPU, corrected_positions=False, min_confidence=0.4)
        assert all(torch.equal(tensor, weights[name]) for name, tensor in network.state_dict().items())
        assert not network.training
        assert network.coarse_matching.thr == 0.4
    assert torch.equal(torch.get_rng_state(), before)


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        loftr_from(path, CPU, corrected_positions=False, min_confidence=0.2)
    return str(caught.value)


def test_loftr_from_rejects_files_without_weights(weights: dict[str, torch.Tensor], tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    assert refused(path) == f"there is no file {path} with weights of LoFTR; check the path"
    path.write_bytes(b"not weights")
    assert refused(path) == f"torch cannot read weights from {path}: UnpicklingError"
    torch.save({"a": 1, "b": "text"}, path)
    assert refused(path) == f"{path} does not hold the weights of LoFTR: expected tensors by name, or under state_dict"
    first, *others = weights
    few = {name: torch.zeros(1) for name in others[:3]}
    torch.save(few, path)
    missing = f"{len(weights) - 3} of {len(weights)} tensors are missing, such as {first}"
    assert refused(path) == f"{path} does not hold the weights of LoFTR: {missing}"
    small = {name: torch.zeros(()) for name in weights}
    torch.save(small, path)
    shape = f"{first} has the shape (), expected {tuple(weights[first].shape)}"
    assert refused(path) == f"{path} does not hold the weights of LoFTR: {shape}"
    torch.save(small | {"depth.head": torch.zeros(1)}, path)
    unknown = f"1 of its {len(weights) + 1} tensors do not belong to LoFTR, such as depth.head"
    assert refused(path) == f"{path} does not hold the weights of LoFTR: {unknown}"


def test_loftr_from_runs_no_code_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "weights.pt"
    torch.save(pytest.approx, path)
    assert refused(path) == f"torch cannot read weights from {path}: UnpicklingError"


def test_untrained_network_locates_nothing(build: Callable, shot: Callable) -> None:
    """With the real network."""
    locator = build()
    pair = [locator.describe(shot(STILL, seed)) for seed in range(2)]
    assert locator.register(*pair, None) == NotLocated("0 matches, fewer than min_inliers = 12", {"matches": 0})
    uncertain = build(min_confidence=0).register(*pair, None)
    assert uncertain.evidence["matches"] > 12


def knows(true: np.ndarray, monkeypatch: pytest.MonkeyPatch, wrong: int = 0) -> None:
    """Replace LoFTR by a network that matches its coarse cells, at half pixels, by the true motion."""

    def forward(self: object, data: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        assert data["image0"].shape == data["image1"].shape == (1, 1, *SHAPE)
        assert 0 <= data["image0"].min() <= data["image0"].max() <= 1
        rows, columns = np.mgrid[0 : SHAPE[0] : 8, 0 : SHAPE[1] : 8]
        cells = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
        partners = transform_points(true, cells - 0.5) + 0.5
        partners[:wrong] = np.random.default_rng(0).uniform((0, 0), (175, 119), (wrong, 2))
        inside = np.all((partners >= 0) & (partners <= [175, 119]), axis=1)
        points = {"keypoints0": cells[inside], "keypoints1": partners[inside]}
        return {name: torch.tensor(each, dtype=torch.float32) for name, each in points.items()}

    monkeypatch.setattr(kornia.feature.LoFTR, "forward", forward)


TRUE = from_parameters([0.12, 0.05, -0.05, 0.1, 9.0, -4.0, 1e-4, -5e-5])


@pytest.mark.parametrize("initial", [None, TRUE, STILL], ids=["unknown", "known", "far off"])
def test_matches_are_converted_to_pixel_centres(
    build: Callable, shot: Callable, monkeypatch: pytest.MonkeyPatch, initial: np.ndarray | None
) -> None:
    """An error of half a pixel would move the corners by 0.1 px. A third of the matches are outliers."""
    knows(TRUE, monkeypatch, wrong=100)
    locator = build()
    moving, fixed = (locator.describe(shot(STILL, seed)) for seed in range(2))
    motion = locator.register(moving, fixed, initial)
    assert isinstance(motion, Located), motion
    assert corner_displacements(motion.homography, TRUE, SHAPE).max() < 0.001
    assert 40 < motion.evidence["inliers"] <= motion.evidence["matches"]


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
