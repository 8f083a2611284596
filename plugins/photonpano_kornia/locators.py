"""Locators by kornia: of brightness, `kornia-registrator`; by matches, `kornia-features` and `kornia-loftr`.

kornia's own `ImageRegistrator` has no masks and starts from the identity only. Its Adam steps stop 0.2 to 0.3 px from the
minimum that L-BFGS reaches on whitened parameters, or take thirty times as long. So only its warper is used here. Keypoints of
SIFT are matched by SMNN or AdaLAM.

torch runs without threads of its own and side effects on the global random generator.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
import torch
from kornia.feature import LoFTR, SIFTFeatureScaleSpace, laf_is_filled, match_adalam, match_smnn
from kornia.feature.loftr.loftr import default_cfg
from kornia.filters import spatial_gradient
from kornia.geometry import RANSAC
from kornia.geometry.transform import HomographyWarper
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from skimage.registration import phase_cross_correlation
from threadpoolctl import ThreadpoolController

from photonpano import FloatArray, Homography, InputError, Located, NotLocated, VirtualExposure
from photonpano.geometry import (
    corner_displacements,
    corners,
    inverse,
    jacobian,
    normalised,
    rescaled,
    transform_points,
    translation,
    why_implausible,
)
from photonpano.locating import (
    NO_TEXTURE,
    NOTHING_SEEN,
    SMALLEST_SIDE,
    Matches,
    MatchingConfig,
    PointLocator,
    View,
    blur_against_noise,
    coarse_to_fine,
    consensus_of,
    free_parameters,
    motion_from_images,
    motion_from_points,
    stabilised_8_bit,
    view_pyramid,
)
from photonpano_kornia.hooks import KorniaFeaturesConfig, KorniaLoftrConfig, KorniaRegistratorConfig

_GENERATOR = Lock()  # held while the global random generator is seeded, which all threads share


def device_of(name: str) -> torch.device:
    """Return the device of a config; raises an `InputError` if torch does not find it."""
    with warnings.catch_warnings():
        # A CUDA build of torch warns if there is no driver; the error below says so.
        warnings.simplefilter("ignore")
        if name == "cuda" and not torch.cuda.is_available():
            raise InputError(
                f"device: cuda is not available: torch {torch.__version__} finds no GPU; use device: cpu, or install a "
                "torch for the GPU and its driver"
            )
    return torch.device(name)


def image_on(device: torch.device, image: NDArray[Any]) -> torch.Tensor:
    """Copy an (H, W) image into a float32 tensor of shape (1, 1, H, W)."""
    return torch.tensor(image, dtype=torch.float32, device=device)[None, None]


@contextmanager
def one_thread() -> Iterator[None]:
    """Keep torch from starting threads of its own, on whose number the rounding of sums depends.

    `torch.set_num_threads` acts on the whole process, the limit of OpenMP on the calling thread only.
    """
    # On its first use in a thread, torch sets the number; this call makes that happen before the limit is set.
    torch.get_num_threads()
    with _openmp().limit(limits=1):
        yield


@cache
def _openmp() -> ThreadpoolController:
    """Return the loaded OpenMP libraries, torch's among them."""
    return ThreadpoolController().select(user_api="openmp")


@contextmanager
def seeded(seed: int, device: torch.device) -> Iterator[None]:
    """Seed the global generators for code that samples from them, and restore them."""
    with _GENERATOR, torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield


def loftr_from(path: Path, device: torch.device, *, corrected_positions: bool, min_confidence: float) -> LoFTR:
    """Return LoFTR with the weights of a file of `torch.save`, ready for inference; only tensors are read, no code is run.

    Raises an `InputError` if the file cannot be read, or holds something else than tensors by name, or these under
    `state_dict`.
    """
    weights = _read(path)
    config = copy.deepcopy(default_cfg)
    config["coarse"]["temp_bug_fix"] = corrected_positions
    config["match_coarse"]["thr"] = min_confidence
    # Construction initialises the weights at random.
    with seeded(0, torch.device("cpu")):
        network = LoFTR(pretrained=None, config=config)
    if reason := _mismatch(network.state_dict(), weights):
        raise InputError(f"{path} does not hold the weights of LoFTR: {reason}")
    network.load_state_dict(weights)
    return network.requires_grad_(False).eval().to(device)


def _read(path: Path) -> dict[str, torch.Tensor]:
    try:
        loaded: Any = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise InputError(f"there is no file {path} with weights of LoFTR; check the path") from None
    except Exception as error:  # its type depends on where the file is damaged
        raise InputError(f"torch cannot read weights from {path}: {type(error).__name__}") from error
    if isinstance(loaded, Mapping):
        loaded = loaded.get("state_dict", loaded)
    if not isinstance(loaded, Mapping) or not all(isinstance(each, torch.Tensor) for each in loaded.values()):
        raise InputError(f"{path} does not hold the weights of LoFTR: expected tensors by name, or under state_dict")
    return {str(name).removeprefix("matcher."): tensor for name, tensor in loaded.items()}


def _mismatch(expected: Mapping[str, torch.Tensor], given: Mapping[str, torch.Tensor]) -> str | None:
    """Return which tensor is missing, unknown or of another shape; None if all match."""
    if missing := [name for name in expected if name not in given]:
        return f"{len(missing)} of {len(expected)} tensors are missing, such as {missing[0]}"
    if unknown := [name for name in given if name not in expected]:
        return f"{len(unknown)} of its {len(given)} tensors do not belong to LoFTR, such as {unknown[0]}"
    for name, tensor in expected.items():
        if given[name].shape != tensor.shape:
            return f"{name} has the shape {tuple(given[name].shape)}, expected {tuple(tensor.shape)}"
    return None


_COARSE_TOLERANCE = 4  # tolerance of coarser layers, which initialise the finest, relative to `converged_px`
_ROUNDS = 3  # most descents on a layer; the weights of pixels are updated in between


def unit_square(shape: tuple[int, int]) -> FloatArray:
    """Return the (3, 3) map from pixels to the coordinates of kornia's warper.

    -1 and 1 are the outer edges of the image, not the centres of its outermost pixels: `align_corners=False`.
    """
    height, width = shape
    return np.array([[2 / width, 0, 1 / width - 1], [0, 2 / height, 1 / height - 1], [0, 0, 1]])


class RegistratorLocator:
    """Finds the homography under which two exposures differ least."""

    def __init__(self, config: KorniaRegistratorConfig) -> None:
        self._config = config
        self._device = device_of(config.device)
        # The first optimizer imports most of torch, which is not safe from several threads at once.
        torch.optim.LBFGS([torch.zeros(1, requires_grad=True)])

    def describe(self, exposure: VirtualExposure) -> tuple[View, ...]:
        """Return the pyramid of the exposure on the scale on which photon noise is uniform, finest first."""
        blur_px = blur_against_noise(exposure, self._config.blur_px)
        return view_pyramid(exposure, blur_px, self._config.pyramid_levels, SMALLEST_SIDE)

    def register(self, moving: tuple[View, ...], fixed: tuple[View, ...], initial: Homography | None) -> Located | NotLocated:
        """Align; see `photonpano.Locator`."""
        if not (moving[-1].seen.any() and fixed[-1].seen.any()):
            return NotLocated(NOTHING_SEEN)
        start = initial
        if start is None:  # the shift of the coarsest images by masked cross-correlation (Padfield 2012)
            correlated: Callable[..., Any] = phase_cross_correlation
            one, other = moving[-1], fixed[-1]
            (down, right), *_ = correlated(other.image, one.image, reference_mask=other.seen, moving_mask=one.seen)
            start = rescaled(translation(float(right), float(down)), one.pixel)
        evaluations: list[int] = []
        n_layers = len(moving)

        def align(one: View, other: View, start: Homography, depth: int) -> Homography | NotLocated:
            descent = _Descent(one, other, free_parameters(depth, n_layers), self._device)
            with one_thread():
                found = descent.from_start(start, self._config, coarse=depth > 0)
            evaluations.append(descent.evaluations)
            return found

        found, failure = coarse_to_fine(moving, fixed, start, align)
        if failure is not None:
            return failure
        evidence = {"evaluations": float(sum(evaluations))}
        return motion_from_images(moving[0], fixed[0], found[-1], self._config, evidence=evidence)


class _Descent:
    def __init__(self, moving: View, fixed: View, free: tuple[int, ...], device: torch.device) -> None:
        self._moving, self._fixed, self._free, self._device = moving, fixed, list(free), device
        self._here, self._there = image_on(device, moving.image), image_on(device, fixed.image)
        # The image is continued beyond its border, which would bias the alignment; weights mask these pixels.
        self._warper = HomographyWarper(*moving.shape, padding_mode="border", align_corners=False)
        self._unit = unit_square(moving.shape)
        self.evaluations = 0

    def from_start(self, homography: Homography, config: KorniaRegistratorConfig, coarse: bool) -> Homography | NotLocated:
        """Return the homography at the minimum, in pixels of the layer."""
        tolerance_px = config.converged_px * (_COARSE_TOLERANCE if coarse else 1)
        root: torch.Tensor | None = None
        for _ in range(_ROUNDS):
            there = self._fixed.seen_from(homography)
            both = self._moving.seen & there.seen
            # The inverse variances of the differences between pixels, 0 where one of them is masked.
            certainty = np.zeros(both.shape, np.float32)
            certainty[both] = 1 / (1 / self._moving.weight[both] + 1 / there.weight[both])
            weights = image_on(self._device, certainty)
            root = self._root_of_curvature(weights) if root is None else root
            if root is None:
                return NotLocated(NO_TEXTURE)
            previous, homography = homography, self._round(homography, weights, root, tolerance_px, config.max_iterations)
            if reason := why_implausible(homography, self._moving.shape, config.min_overlap):
                return NotLocated(f"the alignment diverges: {reason}")
            if corner_displacements(homography, previous, self._moving.shape).max() < tolerance_px:
                break
        return homography

    def _round(
        self,
        start: Homography,
        weights: torch.Tensor,
        root: torch.Tensor,
        tolerance_px: float,
        max_iterations: int,
    ) -> Homography:
        """Return the homography that minimises half the weighted sum of squared differences."""
        origin = torch.tensor(self._unit @ start @ inverse(self._unit), device=self._device)
        unit_loss = 2 * self._loss(origin, weights)
        if unit_loss == 0:
            return start
        # In these parameters the Hessian is the identity and the initial loss is 1/2. The first step of L-BFGS, which is one of
        # gradient descent, is then about a Gauss-Newton step.
        basis = torch.linalg.inv(root).T * torch.sqrt(unit_loss)
        # The largest displacement of a corner by a unit step of one of these parameters.
        unit_corners = corners(self._moving.shape) @ self._unit[:2, :2].T + self._unit[:2, 2]
        moved = jacobian(np.eye(3), unit_corners)[..., self._free] @ basis.cpu().numpy()
        corner_px = float(np.linalg.norm(moved * (np.array(self._moving.shape[::-1]) / 2)[:, None], axis=1).max())
        q = torch.zeros(len(self._free), dtype=torch.float64, device=self._device, requires_grad=True)
        optimizer = torch.optim.LBFGS(
            [q],
            max_iter=max_iterations,
            tolerance_grad=0,
            # torch compares it with the expected decrease of the loss too, which is the square of the step length.
            tolerance_change=(tolerance_px / corner_px) ** 2,
            line_search_fn="strong_wolfe",
        )

        def closure() -> torch.Tensor:
            optimizer.zero_grad()
            loss = self._loss(origin @ self._step(basis @ q), weights) / unit_loss
            loss.backward()
            return loss

        optimizer.step(closure)
        with torch.no_grad():
            found = (origin @ self._step(basis @ q)).cpu().numpy()
        return normalised(inverse(self._unit) @ found @ self._unit) if np.isfinite(found).all() else np.asarray(found)

    def _step(self, p: torch.Tensor) -> torch.Tensor:
        """Return the homography of the free parameters, in kornia's coordinates."""
        full = torch.zeros(8, dtype=torch.float64, device=self._device).index_put((torch.tensor(self._free),), p)
        p1, p2, p3, p4, p5, p6, p7, p8 = full
        one = torch.ones_like(p1)
        return torch.stack([1 + p1, p3, p5, p2, 1 + p4, p6, p7, p8, one]).reshape(3, 3)

    def _loss(self, to_fixed: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
        """Return half the weighted sum of squared differences.

        `to_fixed` (3, 3) maps the moving image to the fixed one, in kornia's coordinates, as the warper maps its output to its
        input.
        """
        self.evaluations += 1
        warped = self._warper(self._there, to_fixed[None].to(torch.float32))
        return (weights * (warped - self._here) ** 2).sum(dtype=torch.float64) / 2

    def _root_of_curvature(self, weights: torch.Tensor) -> torch.Tensor | None:
        """Return the Cholesky factor of the Hessian of the loss, from the moving image; None without texture."""
        height, width = self._moving.shape
        along = spatial_gradient(self._here, mode="diff")[0, 0]
        gx, gy = along[0] * (width / 2), along[1] * (height / 2)
        x = torch.arange(width, device=self._device) * self._unit[0, 0] + self._unit[0, 2]
        y = torch.arange(height, device=self._device)[:, None] * self._unit[1, 1] + self._unit[1, 2]
        inwards = gx * x + gy * y
        slopes = torch.stack([gx * x, gy * x, gx * y, gy * y, gx, gy, -inwards * x, -inwards * y])[self._free]
        # Row by row: the rounding of a matrix product depends on MKL's number of threads.
        rows = [(slopes * (weights[0, 0] * slope)).sum(dim=(1, 2), dtype=torch.float64) for slope in slopes]
        root, failed = torch.linalg.cholesky_ex(torch.stack(rows))
        return None if failed else root


_FAR = 1e3  # descriptor distance of keypoints beyond the search radius; true ones are at most 2
_SMALLEST_SIDE = 32  # px: four of the cells that LoFTR matches first
_CONFIDENCE = 0.999  # probability of having found the best motion at which RANSAC stops


@dataclass(frozen=True, slots=True, eq=False)
class SiftFeatures:
    """Keypoints of one exposure."""

    # (N, 2, 3), kornia's local affine frames: the last column is the position, the others the shape
    frames: NDArray[np.float32]
    descriptors: NDArray[np.float16]  # (N, 128), RootSIFT
    shape: tuple[int, int]  # (height, width) of the exposure

    @property
    def points(self) -> FloatArray:
        """(N, 2) positions; in kornia's features pixel centres are integers."""
        return self.frames[:, :, 2].astype(np.float64)

    @property
    def sizes(self) -> FloatArray:
        """(N,) diameters of the keypoints in px."""
        return np.asarray(np.sqrt(np.abs(np.linalg.det(self.frames[:, :, :2].astype(np.float64)))))


class FeatureLocator(PointLocator):
    """Detects keypoints once, matches them, finds a consensus, and fits all inliers."""

    def __init__(self, config: KorniaFeaturesConfig, seed: int) -> None:
        self._config: KorniaFeaturesConfig = config
        self._seed = seed
        self._device = device_of(config.device)

    def describe(self, exposure: VirtualExposure) -> SiftFeatures:
        """Detect keypoints on the variance-stabilised image, outside of masked areas."""
        config = self._config
        image, mask = stabilised_8_bit(exposure, blur_against_noise(exposure, config.blur_px))
        if not mask.any():
            return SiftFeatures(np.zeros((0, 2, 3), np.float32), np.zeros((0, 128), np.float16), mask.shape)
        with one_thread(), torch.inference_mode():
            # A detector for each call: kornia does not guarantee thread safety.
            sift = SIFTFeatureScaleSpace(
                config.max_keypoints, config.upright, device=self._device, descriptor_backend="pyramid"
            )
            frames, _, descriptors = sift(image_on(self._device, image) / 255, image_on(self._device, mask) > 0)
            # kornia pads its result with empty frames.
            filled = laf_is_filled(frames)[0]
            return SiftFeatures(
                frames[0, filled].cpu().numpy(), descriptors[0, filled].half().cpu().numpy(), (mask.shape[0], mask.shape[1])
            )

    def _homography(self, moving: SiftFeatures, fixed: SiftFeatures, initial: Homography | None) -> Located | NotLocated:
        evidence = {"keypoints_moving": float(len(moving.frames)), "keypoints_fixed": float(len(fixed.frames))}
        with one_thread(), torch.inference_mode():
            return _motion_of(self._matches(moving, fixed, initial), moving.shape, self._config, self._seed, evidence)

    def _matches(self, moving: SiftFeatures, fixed: SiftFeatures, initial: Homography | None) -> Iterator[Matches]:
        for guide in [initial, None] if initial is not None else [None]:
            pairs = self._matched(moving, fixed, guide)
            here, there = moving.points[pairs[:, 0]], fixed.points[pairs[:, 1]]
            yield Matches(here, there, guide is not None, moving.sizes[pairs[:, 0]])

    def _matched(self, moving: SiftFeatures, fixed: SiftFeatures, guide: Homography | None) -> NDArray[np.intp]:
        """Return the pairs of indices (K, 2) of keypoints that match."""
        if min(len(moving.frames), len(fixed.frames)) < 2:
            return np.zeros((0, 2), dtype=np.intp)
        here, there = (torch.tensor(each.descriptors, dtype=torch.float32, device=self._device) for each in (moving, fixed))
        distances = torch.cdist(here, there)
        near = None
        if guide is not None:
            near = cdist(transform_points(guide, moving.points), fixed.points) <= self._config.search_px
            distances.masked_fill_(torch.tensor(~near, device=self._device), _FAR)
        if self._config.matcher == "smnn":
            _, pairs = match_smnn(here, there, self._config.ratio, distances)
        else:
            frames = (torch.tensor(each.frames, device=self._device)[None] for each in (moving, fixed))
            # AdaLAM samples from the global generator.
            with seeded(self._seed, self._device):
                _, pairs = match_adalam(here, there, *frames, hw1=moving.shape, hw2=fixed.shape, dm=distances)
        found = np.asarray(pairs.cpu().numpy(), np.intp)
        return found if near is None else found[near[found[:, 0], found[:, 1]]]


class Picture(NamedTuple):
    """An exposure as input of LoFTR. Its feature maps would take fifty times the memory."""

    image: NDArray[np.uint8]  # (H, W); masked pixels have the mean of the others
    seen: NDArray[np.bool_]  # (H, W), False for masked pixels


class LoftrLocator:
    """LoFTR, learned matching without keypoints (Sun et al. 2021), then a consensus, and a fit of all inliers."""

    def __init__(self, config: KorniaLoftrConfig, seed: int) -> None:
        self._config = config
        self._seed = seed
        self._device = device_of(config.device)
        self._network = loftr_from(
            config.weights,
            self._device,
            corrected_positions=config.corrected_positions,
            min_confidence=config.min_confidence,
        )

    def describe(self, exposure: VirtualExposure) -> Picture:
        """Return the exposure on the scale on which photon noise is uniform, in 8 bits."""
        image, mask = stabilised_8_bit(exposure, blur_against_noise(exposure, self._config.blur_px))
        seen = mask > 0
        if seen.any():
            image[~seen] = np.uint8(image[seen].mean())
        return Picture(image, seen)

    def register(self, moving: Picture, fixed: Picture, initial: Homography | None) -> Located | NotLocated:
        """Match and fit; see `photonpano.Locator`."""
        if min(moving.image.shape) < _SMALLEST_SIDE:
            height, width = moving.image.shape
            return NotLocated(f"the images have {height}x{width} px, LoFTR needs at least {_SMALLEST_SIDE} along each side")
        if not (moving.seen.any() and fixed.seen.any()):
            return NotLocated("all pixels are masked")
        with one_thread(), torch.inference_mode():
            here, there = self._matched(moving, fixed)
            shape = (moving.image.shape[0], moving.image.shape[1])
            return _motion_of(self._attempts(here, there, initial), shape, self._config, self._seed, {})

    def _attempts(self, here: FloatArray, there: FloatArray, initial: Homography | None) -> Iterator[Matches]:
        """Yield the matches near the positions that the current motion predicts, then all."""
        if initial is not None:
            near = np.linalg.norm(transform_points(initial, here) - there, axis=1) <= self._config.search_px
            yield Matches(here[near], there[near], guided=True)
        yield Matches(here, there, guided=False)

    def _matched(self, moving: Picture, fixed: Picture) -> tuple[FloatArray, FloatArray]:
        """Return the matched points of both images, (N, 2) each, that are not masked in either."""
        images = (image_on(self._device, each.image) / 255 for each in (moving, fixed))
        answer = self._network(dict(zip(("image0", "image1"), images, strict=True)))
        # LoFTR has the centre of the first pixel at (0.5, 0.5).
        here, there = (answer[key].cpu().numpy().astype(np.float64) - 0.5 for key in ("keypoints0", "keypoints1"))
        counts = _seen_at(moving.seen, here) & _seen_at(fixed.seen, there)
        return here[counts], there[counts]


def _seen_at(seen: NDArray[np.bool_], points: FloatArray) -> NDArray[np.bool_]:
    """Return which points (N, 2) lie on unmasked pixels: (N,) bool; a point outside of the image takes the nearest pixel."""
    columns, rows = (np.clip(np.rint(points[:, axis]).astype(int), 0, seen.shape[1 - axis] - 1) for axis in (0, 1))
    return np.asarray(seen[rows, columns])


def _motion_of(
    attempts: Iterable[Matches], shape: tuple[int, int], config: MatchingConfig, seed: int, evidence: Mapping[str, float]
) -> Located | NotLocated:
    """Return the motion of the first matches that agree by RANSAC, or why the last do not: see `consensus_of`."""

    def estimate(moving: NDArray[np.floating], fixed: NDArray[np.floating]) -> Homography:
        ransac = RANSAC("homography", inl_th=config.threshold_px, confidence=_CONFIDENCE, seed=seed)
        # On the CPU: these are a few small matrices.
        model, _ = ransac(torch.tensor(moving), torch.tensor(fixed))
        return np.asarray(model.numpy())

    consensus = consensus_of(attempts, estimate, config, evidence)
    if isinstance(consensus, NotLocated):
        return consensus
    matches, homography, found = consensus
    return motion_from_points(matches.moving, matches.fixed, homography, shape, config, sizes=matches.sizes, evidence=found)
