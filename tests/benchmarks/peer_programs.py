"""Run one program on a capture, for peers.py: its motion, its picture, and what it took.

    python peer_programs.py PROGRAM CAPTURE.npy GROUP_SIZE RESULT.npz [--code PLACE] [--mended]

It needs no photonpano but for the program of that name, so that each program can have an interpreter of its own. The result
has what a program shows: `homographies`, (T, 3, 3), pixels of each frame to a plane, the frames that are `located`, (T,), and
the `frame_shape`, as trajectory.npz of a run has them; and `flux`, the picture, NaN where nothing was seen. It always has
`cpu_s`, seconds of the processor, and `mib`, the largest memory.
"""

from __future__ import annotations

import argparse
import importlib
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

WHITE = 0.999  # quantile of the flux that is white in 8 bits
LEVELS = 2  # of quantaodometry
BURST = 77  # frames of cQBPy's pipeline: 11 times 7, as in its parameters
MIN_MATCHES = 10
MIN_COVERAGE = 0.05  # of what is usual, for a pixel to be compared, as for `photonpano evaluate`


class Task(NamedTuple):
    """A packed capture, the number of frames in a group, where the code of a program is, and whether its defects are mended."""

    capture: Path
    group: int
    code: Path | None
    mended: bool

    @property
    def frames(self) -> NDArray[np.uint8]:
        """(T, H, W / 8)"""
        return np.load(self.capture, mmap_mode="r")


Result = tuple[NDArray[np.float64] | None, NDArray[np.float32] | None]


def flux_of(rate: NDArray[Any]) -> NDArray[np.float32]:
    """Return the photons in a frame of which a share of binary frames is lit."""
    return np.asarray(-np.log1p(-np.minimum(rate, 1 - 1e-6)), np.float32)


def rates(task: Task) -> NDArray[np.float32]:
    """Return the share of lit frames in each group: (N, H, W)."""
    groups = np.array_split(task.frames, len(task.frames) // task.group)
    return np.stack([np.unpackbits(each, axis=-1).mean(axis=0, dtype=np.float32) for each in groups])


def in_8_bits(flux: NDArray[np.float32]) -> tuple[NDArray[np.uint8], float]:
    """Return flux as sRGB with a gamma of 2.2, and the flux that is white."""
    white = float(np.quantile(flux, WHITE))
    return np.asarray(np.rint(255 * np.clip(flux / white, 0, 1) ** (1 / 2.2)), np.uint8), white


def of_frames(knots: NDArray[np.float64], at: NDArray[np.float64], n_frames: int) -> NDArray[np.float64]:
    """Interpolate homographies, (N, 3, 3), of groups linearly to all frames; half a group beyond the first and last at most."""
    knots = knots / knots[:, 2:, 2:]
    if len(knots) > 1:
        knots = np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
        at = np.concatenate([2 * at[:1] - at[1:2], at, 2 * at[-1:] - at[-2:-1]])
    places = np.arange(n_frames)
    entries = [np.interp(places, at, each) for each in knots.reshape(-1, 9).T]
    homographies = np.stack(entries, axis=-1).reshape(-1, 3, 3)
    reach = (at[1] - at[0]) / 2 if len(at) > 1 else 0
    outside = (places < at[0] + reach - 1) | (places > at[-1] - reach + 1)
    homographies[outside] = np.nan
    return homographies


def photonpano(task: Task) -> Result:
    """Run photonpano with all defaults."""
    library, evaluation = importlib.import_module("photonpano"), importlib.import_module("photonpano.evaluation")
    source = {"use": "packed-npy", "with": {"path": str(task.capture.resolve()), "frame_rate_hz": 96_800}}
    folder = task.capture.with_suffix(".run")
    shutil.rmtree(folder, ignore_errors=True)
    library.run(library.parse_spec({"version": 1, "source": source, "run": {"threads": 1}}, output=folder))
    found = evaluation.load_run_trajectory(folder)
    homographies = np.where(found.located[:, None, None], found.corner_homographies, np.nan)
    flux, weight = evaluation.load_panorama(folder)
    return homographies, np.where(evaluation.covered(weight), flux, np.nan)


def quantaodometry(task: Task) -> Result:
    """Run the authors' code: three levels, and otherwise its defaults, relative to the frame in the middle."""
    sys.path.insert(0, str(task.code / "src" if task.code else ""))
    torch, colour = importlib.import_module("torch"), importlib.import_module("quantaodometry.color")
    panorama = importlib.import_module("quantaodometry.panorama")
    if task.mended:
        mend_quantaodometry(panorama)
    frames, first = task.frames, flux_of(np.unpackbits(task.frames[: task.group], axis=-1).mean(axis=0))
    factor = float(np.quantile(first, WHITE))

    class Frames:
        crop_size = (*first.shape, 1)

        def __len__(self) -> int:
            return len(frames)

        def __getitem__(self, index: int) -> Any:
            return torch.from_numpy(np.unpackbits(frames[index], axis=-1).astype(np.float32))

        def as_dataset(self) -> Any:
            return self

        def post_merge_transform(self, patch: Any, **_: Any) -> Any:
            return colour.linearrgb_to_srgb(colour.binary2rgb(patch, factor=factor))

    with torch.no_grad():
        _, canvas, _, _, spline, _ = panorama.Panorama.construct(
            Frames(), levels=LEVELS, burst_size=task.group, wrt=0.5, num_workers=0, pano_transform=None, full=True,
            endpoints="estimate" if task.mended else "extrapolate",
        )  # fmt: skip
        lit, weight = canvas.as_tensor()[0].numpy()
    from_plane = np.asarray(spline(np.linspace(0, 1, len(frames))), np.float64)
    to_centres = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # the middle of its first pixel is (0.5, 0.5)
    to_plane = np.linalg.inv(to_centres) @ np.linalg.inv(from_plane) @ to_centres
    with np.errstate(invalid="ignore", divide="ignore"):
        return to_plane, np.where(weight >= MIN_COVERAGE * np.median(weight[weight > 0]), flux_of(lit / weight), np.nan)


def mend_quantaodometry(panorama: Any) -> None:
    """Mend what makes it stop, and the window at the end.

    Images without keypoints and pairs without a homography count as pairs without matches, which it interpolates; splines of
    fewer than four exposures have the degree that these allow; the last window holds the last frame.
    """
    localizers, homography = (importlib.import_module(f"quantaodometry.{name}") for name in ("localizers", "homography"))
    match, fit, spline, sampler = (
        localizers.match_keypoints, localizers.get_homography, homography.homography_interp, panorama.Panorama.midpoint_sampler,
    )  # fmt: skip

    def matched(first: Any, second: Any, *args: Any, **options: Any) -> Any:
        if first is None or second is None or min(len(first), len(second)) < 2:
            raise RuntimeError("an image has no keypoints")
        return match(first, second, *args, **options)

    def fitted(*args: Any, **options: Any) -> Any:
        found = fit(*args, **options)
        if found[0] is None:
            raise RuntimeError("no homography agrees with the matches")
        return found

    class Spline(spline):
        def __init__(self, hs: Any, ts: Any = None, *, mode: Any, interp_kind: str = "cubic") -> None:
            hs = list(hs)
            if len(hs) == 1:
                hs, ts = hs * 2, [ts[0], ts[0] + 1]
            degree = min(len(hs) - 1, 3) if interp_kind == "cubic" else interp_kind
            super().__init__(hs, ts, mode=mode, interp_kind=degree)

    def sampled(n: int, burst_size: int, endpoints: bool = True, strict: bool = False) -> Any:
        for centres, windows in sampler(n, burst_size, endpoints, strict):
            short = [len(each) < burst_size and each[0] > 0 for each in windows]
            yield centres, [each + 1 if is_last else each for each, is_last in zip(windows, short, strict=True)]

    localizers.match_keypoints, localizers.get_homography = matched, fitted
    panorama.homography_interp = localizers.homography_interp = homography.homography_interp = Spline
    panorama.Panorama.midpoint_sampler = staticmethod(sampled)


def cqbpy(task: Task) -> Result:
    """Run burst photography with respect to the frame in the middle: the pipeline on one burst, or its parts when mended."""
    sys.path.insert(0, str(task.code or ""))
    if task.mended:
        return mended_cqbpy(task)
    pipeline = importlib.import_module("quanta_color_pipeline")
    first = (len(task.frames) - BURST) // 2
    frames = np.moveaxis(np.unpackbits(task.frames[first : first + BURST], axis=-1), 0, -1)
    settings = pipeline.QuantaParams(refFrame=BURST // 2, eta=np.ones(3, np.float32))
    found = pipeline.QuantaBurstPipeline(settings).run(frames)
    homographies = np.full((len(task.frames), 3, 3), np.nan)
    homographies[first : first + BURST] = np.eye(3)
    # It samples a frame at the place in the reference plus the flow.
    homographies[first : first + BURST, :2, 2] = -found["flows"][0, 0].T
    return homographies, found["merged"].mean(axis=-1)


def mended_cqbpy(task: Task) -> Result:
    """Align sums of groups patch by patch, and merge their rates.

    The search of patches is a method that numba cannot compile; here it is a function. The pipeline does not call it: it shifts
    single binary frames, merges them with the sign of the shift reversed, and weighs them by the median of bits, which is 0.
    """
    numba, alignment, merging = (importlib.import_module(name) for name in ("numba", "alignment", "merging"))
    search = alignment.HierarchicalAlignment._block_match_with_init
    compiled = numba.njit(search.py_func)

    def searched(self: Any, *arguments: Any) -> Any:
        return compiled(0, *arguments)

    alignment.HierarchicalAlignment._block_match_with_init = searched
    lit = rates(task)
    half = np.stack([alignment.bayer_to_grayscale_downsample(each) for each in lit * task.group], axis=-1)
    # Two levels: a third is no larger than a patch, in frames of 128x192 px.
    aligner = alignment.HierarchicalAlignment(num_levels=2, patch_sizes=(16, 16), search_radii=(2, 8))
    flows, _ = aligner.align(half)
    y, x = (np.mgrid[8 : half.shape[0] - 8 : 8, 8 : half.shape[1] - 8 : 8]).reshape(2, -1)
    here = np.stack([x, y], axis=-1).astype(np.float64)
    knots = np.full((len(lit), 3, 3), np.nan)
    for index in range(len(lit)):
        there = here + flows[y, x, :, index]
        found, _ = cv2.estimateAffinePartial2D(2 * there + 0.5, 2 * here + 0.5, None, cv2.RANSAC, 3.0)
        knots[index] = np.eye(3) if found is None else np.vstack([found, [0, 0, 1]])
    full = np.repeat(np.repeat(2 * flows, 2, axis=0), 2, axis=1)
    _, merged = merging.robust_merge_bayer(np.moveaxis(lit, 0, -1), full)
    return of_frames(knots, centres(task, len(lit)), len(task.frames)), flux_of(merged)


def centres(task: Task, n_groups: int) -> NDArray[np.float64]:
    """Return the middles of the groups, as indices of frames."""
    starts = np.cumsum([0, *(len(each) for each in np.array_split(np.arange(len(task.frames)), n_groups))])
    return np.asarray((starts[:-1] + starts[1:] - 1) / 2, np.float64)


def spano(task: Task) -> Result:
    """Run spano's command, which writes a panorama in 8 bits and no motion."""
    picture = task.capture.with_suffix(".spano.png")
    options = ["--burst-size", str(task.group - task.group % 8), "--granularity", "8", "--invert-response", "--tonemap2srgb"]
    subprocess.run([str(task.code), "pano", "-i", str(task.capture), "-o", str(picture), *options], check=True)
    return None, seen(cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE))


def seen(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the flux of a picture in 8 bits up to its white, NaN where it is black about its border."""
    known = cv2.erode(np.asarray(cv2.medianBlur(picture, 5) > 0, np.uint8), np.ones((5, 5), np.uint8)) > 0
    return np.where(known, (picture / np.float32(255)) ** np.float32(2.2), np.nan)


def stitcher(task: Task) -> Result:
    """Stitch averages with OpenCV, as scans: by affine maps."""
    lit = rates(task)
    flux = flux_of(lit)
    white = in_8_bits(flux)[1]
    images = [cv2.cvtColor(in_8_bits(np.minimum(each, white))[0], cv2.COLOR_GRAY2BGR) for each in flux]
    stitched = cv2.Stitcher.create(cv2.Stitcher_SCANS)
    status, picture = stitched.stitch(images)
    if status != cv2.Stitcher_OK:
        raise RuntimeError({1: "needs more images", 2: "estimates no homography", 3: "adjusts no cameras"}[status])
    used = np.asarray(stitched.component()).ravel()
    order = np.argsort(used)
    # Its maps lead from the panorama to an image.
    knots = np.stack([np.linalg.inv(np.asarray(stitched.cameras()[index].R, np.float64)) for index in order])
    at = centres(task, len(lit))[used[order]]
    return of_frames(knots, at, len(task.frames)), seen(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))


def colmap(task: Task) -> Result:
    """Chain homographies between averages, of COLMAP's SIFT, matcher and LO-RANSAC; it makes no picture of them."""
    pycolmap = importlib.import_module("pycolmap")
    cpu, sift = pycolmap.Device.cpu, pycolmap.FeatureExtractorType.SIFT
    extractor = pycolmap.FeatureExtractor.create(pycolmap.FeatureExtractionOptions(use_gpu=False), cpu)
    matcher = pycolmap.FeatureMatcher.create(pycolmap.FeatureMatchingOptions(use_gpu=False), cpu)
    flux = flux_of(rates(task))
    found = [extractor.extract_from_uint8_array(in_8_bits(each)[0]) for each in flux]
    features = [(points, pycolmap.FeatureDescriptors(sift, each.data)) for points, each in found]
    points = [np.array([(each.x, each.y) for each in those]).reshape(-1, 2) - 0.5 for those, _ in found]
    parts: list[list[NDArray[np.float64]]] = [[np.eye(3)]]
    for index in range(1, len(flux)):
        pairs = np.zeros((0, 2), int)
        if min(len(points[index - 1]), len(points[index])) >= MIN_MATCHES:
            pairs = np.asarray(matcher.match(*features[index], *features[index - 1]), int).reshape(-1, 2)
        step = None
        if len(pairs) >= MIN_MATCHES:
            options = pycolmap.RANSACOptions(max_error=2.0, random_seed=0)
            step = pycolmap.estimate_homography_matrix(points[index][pairs[:, 0]], points[index - 1][pairs[:, 1]], options)
        if step is None:
            parts.append([np.eye(3)])
        else:
            parts[-1].append(parts[-1][-1] @ step["H"] / step["H"][2, 2])
    longest = max(range(len(parts)), key=lambda index: len(parts[index]))
    first = sum(len(part) for part in parts[:longest])
    if len(parts[longest]) < 2:
        raise RuntimeError("no pair of averages is registered")
    at = centres(task, len(flux))[first : first + len(parts[longest])]
    return of_frames(np.stack(parts[longest]), at, len(task.frames)), None


PROGRAMS: dict[str, Callable[[Task], Result]] = {
    each.__name__: each for each in (photonpano, quantaodometry, spano, cqbpy, stitcher, colmap)
}


def own_kib() -> int:
    """Return the largest memory of this process; `getrusage` counts that of the process which has started it as well."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return int(re.findall(r"VmHWM:\s+(\d+) kB", status)[0])


def main(given: Sequence[str] | None = None) -> None:
    """Run the program, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", choices=PROGRAMS)
    parser.add_argument("capture", type=Path)
    parser.add_argument("group", type=int)
    parser.add_argument("result", type=Path)
    parser.add_argument("--code", type=Path)
    parser.add_argument("--mended", action="store_true")
    options = parser.parse_args(given)
    task = Task(options.capture, options.group, options.code, options.mended)
    shape = (task.frames.shape[1], 8 * task.frames.shape[2])
    homographies, flux = PROGRAMS[options.program](task)
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    content: dict[str, Any] = {
        "flux": flux,
        "cpu_s": sum(each.ru_utime + each.ru_stime for each in used),
        "mib": max(used[1].ru_maxrss, own_kib()) / 1024,
    }
    if homographies is not None:
        located = np.isfinite(homographies).all(axis=(1, 2))
        content["homographies"] = np.where(located[:, None, None], homographies, np.eye(3))
        content |= {"located": located, "frame_shape": np.array(shape)}
    np.savez_compressed(options.result, **{key: value for key, value in content.items() if value is not None})


if __name__ == "__main__":
    main()
