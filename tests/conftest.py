"""Small captures, exposures and motions for many tests: in memory, and simulated for whole runs."""

from __future__ import annotations

import gc
import importlib.util
import os
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from scipy.spatial.transform import Rotation

from photonpano import FrameSpan, Group, StageContext, StreamInfo, Trajectory, VirtualExposure
from photonpano.execution.threads import one_thread_inside
from photonpano.geometry import from_parameters, normalised, translation
from photonpano.photometry import BinaryResponse
from photonpano.pipeline.run import RunResult
from photonpano.plugins import registry
from photonpano.plugins.registry import DISABLE
from photonpano.testing import KnownMotion, MemorySource
from photonpano_simulator import scenes

sys.path.append(str(Path(__file__).parent / "benchmarks" / "baselines"))  # a plugin that is not installed

FRAME_SHAPE = (254, 496)
FOCAL_PX = 1500.0

settings.register_profile("suite", max_examples=50, deadline=None)  # the machine may be busy
settings.load_profile("suite")


def sibling(name: str) -> Any:
    """Import a module of this folder."""
    spec = importlib.util.spec_from_file_location(name, Path(__file__).parent / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def browser_page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Lend a page of a headless Chromium."""
    browser = sibling("browser")
    if browser.chromium() is None:
        pytest.skip("Chromium is not installed (Debian: apt-get install chromium)")
    with browser.browser(tmp_path_factory.mktemp("browser")) as page:
        yield page


@pytest.fixture(scope="session")
def bounds() -> Any:
    """The bounds on errors of registration, which benchmarks use as well."""
    return sibling("benchmarks/bounds")


@pytest.fixture(scope="session")
def file_server() -> Callable[..., Any]:
    """Return the class of servers that serve a folder over HTTP, and as an object store."""
    pytest.importorskip("aiohttp", reason="URLs need photonpano[http]")
    return sibling("file_server").FileServer


@pytest.fixture
def object_store(file_server: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Serve the folder `store`, whose folders are buckets, as s3://, for anybody."""
    s3fs = pytest.importorskip("s3fs", reason="s3:// needs photonpano[s3]")
    import fsspec

    (tmp_path / "store" / "bucket").mkdir(parents=True)
    with file_server(tmp_path / "store") as server:
        monkeypatch.setenv("AWS_ENDPOINT_URL", server.address)
        monkeypatch.setitem(fsspec.config.conf, "s3", {"anon": True})
        s3fs.S3FileSystem.clear_instance_cache()
        yield server
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture(scope="session")
def memory_source() -> type[MemorySource]:
    return MemorySource


@pytest.fixture(scope="session")
def known_motion() -> type[KnownMotion]:
    return KnownMotion


@pytest.fixture(scope="session")
def pan() -> Callable[..., KnownMotion]:
    """Return a motion of `x_px` and `y_px` pixels per frame."""

    def make(x_px: float, y_px: float = 0.0) -> KnownMotion:
        return KnownMotion(lambda frame: translation(x_px * frame, y_px * frame))

    return make


@pytest.fixture(scope="session")
def street() -> np.ndarray:
    """(682, 1024) of flux, 0.5 photons per pixel per frame on average."""
    from photonpano_simulator.config import StreetScene
    from photonpano_simulator.scenes import scene_flux

    return scene_flux(StreetScene(width=1024, height=682), 0.5)


@pytest.fixture(scope="session")
def photograph() -> Callable[..., VirtualExposure]:
    """Simulate a virtual exposure of an image of flux: 250 frames, without motion, with photon noise."""
    n_frames, response = 250, BinaryResponse()

    def photograph(flux: np.ndarray, seed: int = 0) -> VirtualExposure:
        counts = np.random.default_rng(seed).binomial(n_frames, -np.expm1(-flux.astype(float)))
        weight = np.full(flux.shape, n_frames, np.float32)
        estimate = response.flux((counts / n_frames).astype(np.float32), weight)
        return VirtualExposure(estimate, weight, Group(FrameSpan(0, n_frames), 0), 1.0, response)

    return photograph


@pytest.fixture(scope="session")
def seen_from(street: np.ndarray, photograph: Callable) -> Callable[..., VirtualExposure]:
    """Simulate an exposure of (160, 240) px: `motion` maps its pixels to those of the exposure for the identity."""
    import cv2

    def seen_from(motion: np.ndarray, seed: int = 0, brightness: float = 1.0) -> VirtualExposure:
        to_street = translation(400, 280) @ motion
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return photograph(cv2.warpPerspective(street, to_street, (240, 160), flags=flags) * brightness, seed)

    return seen_from


@pytest.fixture(scope="session")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Write a small capture and its truth: 300 frames of 128x160 px of a street, on a pan of 60 px with tremor."""
    from photonpano.capture.writing import write_packed
    from photonpano.pipeline.components import build_source
    from photonpano.specs import parse_spec

    def simulated(**changes: Any) -> Path:
        shake = {"rms_px": 3, "frequencies_hz": [300, 400, 600]}
        settings = {
            "scene": {"kind": "street", "width": 1024, "height": 682, "seed": 1},
            "path": {"kind": "pan", "length_px": 60, "angle_deg": 10, "shake": shake},
            "n_frames": 300,
            "frame_shape": [128, 160],
        }
        spec = {"version": 1, "source": {"use": "simulator", "with": settings | changes}}
        path = tmp_path_factory.mktemp("capture") / "cube.npy"
        with build_source(parse_spec(spec)) as source:
            write_packed(source, path)
        return path

    return simulated


@pytest.fixture(scope="session")
def small_capture(simulated: Callable[..., Path]) -> Path:
    return simulated()


@pytest.fixture(scope="session")
def small_spec(small_capture: Path) -> dict[str, Any]:
    """A spec of the small capture with groups of 50 frames."""
    return {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(small_capture), "frame_rate_hz": 96800}},
        "resample": {"use": "midpoint", "with": {"group_size": 50}},
    }


@pytest.fixture(scope="session")
def small_run(small_spec: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """A whole run of the small capture. Tests must not change its folder."""
    from photonpano import run
    from photonpano.specs import parse_spec

    return run(parse_spec(small_spec, output=tmp_path_factory.mktemp("runs") / "small"))


@pytest.fixture(scope="session")
def tiny_capture(simulated: Callable[..., Path]) -> Path:
    """160 frames of 64x96 px, a pan of 40 px, for runs of which the accuracy does not matter."""
    return simulated(n_frames=160, frame_shape=[64, 96], path={"kind": "pan", "length_px": 40, "angle_deg": 10})


@pytest.fixture(scope="session")
def tiny_spec(tiny_capture: Path) -> dict[str, Any]:
    """A spec of the tiny capture with one level of four groups."""
    source = {"use": "packed-npy", "with": {"path": str(tiny_capture), "frame_rate_hz": 96800}}
    return {"version": 1, "source": source, "resample": {"with": {"group_size": 40}}, "levels": 1}


@pytest.fixture(scope="session")
def clouds() -> Callable[..., np.ndarray]:
    """Return (n, H, W) binary frames of a cloudy scene, without edges, that moves by 0.2 px a frame along both axes."""

    def clouds(flux: float = 0.3, shape: tuple[int, int] = (64, 96), n_frames: int = 384, seed: int = 0) -> np.ndarray:
        import cv2

        rng = np.random.default_rng(seed)
        (height, width), far = shape, n_frames // 5 + 1
        noise = cv2.GaussianBlur(rng.standard_normal((height + far, width + far)).astype(np.float32), (0, 0), 2.5)
        scene = flux * np.exp(0.7 * noise / noise.std())
        frames = np.empty((n_frames, *shape), np.uint8)
        for index, frame in enumerate(frames):
            at = index // 5
            frame[:] = rng.random(shape) < -np.expm1(-scene[at : at + height, at : at + width])
        return frames

    return clouds


@pytest.fixture(scope="session")
def fit() -> Callable[..., Trajectory]:
    """Fit by name: `fit("lie", instants, homographies, information=None, **config)`."""
    import photonpano_baselines

    catalog = photonpano_baselines.catalog()
    context = StageContext(StreamInfo(1000, *FRAME_SHAPE, None), response=None)

    def fit(name: str, instants: Any, homographies: np.ndarray, information: np.ndarray | None = None, **config: float) -> Any:
        contribution = catalog.find("interpolator", name).contribution
        interpolator = contribution.build(contribution.config(**config), context)
        return interpolator.fit(np.asarray(instants, dtype=float), homographies, information)

    return fit


@pytest.fixture(scope="session")
def turning() -> Callable[[np.ndarray], np.ndarray]:
    """Return the homographies of a phone camera rotated by (T, 3) rotation vectors, in radians."""
    height, width = FRAME_SHAPE
    lens = np.array([[FOCAL_PX, 0, (width - 1) / 2], [0, FOCAL_PX, (height - 1) / 2], [0, 0, 1]])

    def turning(vectors: np.ndarray) -> np.ndarray:
        return normalised(lens @ Rotation.from_rotvec(vectors).as_matrix() @ np.linalg.inv(lens))

    return turning


@pytest.fixture(scope="session")
def motions() -> Callable[[int, int], np.ndarray]:
    """Return (N, 3, 3) random homographies, of more than rotating cameras: `motions(n, seed)`."""

    def motions(n: int, seed: int) -> np.ndarray:
        sizes = np.array([1e-2, 1e-2, 1e-2, 1e-2, 30, 30, 1e-5, 1e-5])
        return from_parameters(np.random.default_rng(seed).normal(size=(n, 8)) * sizes)

    return motions


@pytest.fixture
def write_video(tmp_path: Path) -> Callable[..., Path]:
    """Write grey levels unchanged as the luma of a video."""

    def write(frames: np.ndarray, name: str, codec: str, pixels: str, **options: Any) -> Path:
        av = pytest.importorskip("av")
        with av.open(str(tmp_path / name), "w") as container:
            stream = container.add_stream(codec, rate=30, options={key: str(value) for key, value in options.items()})
            stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixels
            for levels in frames:
                frame = av.VideoFrame(levels.shape[1], levels.shape[0], pixels)
                luma = np.zeros((levels.shape[0], frame.planes[0].line_size), np.uint8)
                flat = levels.reshape(len(levels), -1).view(np.uint8)
                luma[:, : flat.shape[1]] = flat
                for plane, content in zip(frame.planes, [luma] + 2 * [None], strict=False):
                    plane.update(np.full(plane.buffer_size, 128, np.uint8) if content is None else content)
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
        return tmp_path / name

    return write


@pytest.fixture(scope="session", autouse=True)
def one_thread_for_each_process() -> Iterator[None]:
    """Keep OpenCV and BLAS from starting threads: every core has a process with tests already."""
    with one_thread_inside():
        yield


@pytest.fixture(scope="session", autouse=True)
def files_left_in_memory() -> Iterator[None]:
    """Do not wait for the disk, as no test of this process looks at files after a loss of power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", os.fstat)
        yield


@pytest.fixture(scope="session", autouse=True)
def streets_drawn_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Draw each street once: many tests simulate the same one, and drawing it takes longer than a small run."""
    own, draw = tmp_path_factory.mktemp("street"), scenes.street
    folder = (own.parents[1] if "PYTEST_XDIST_WORKER" in os.environ else own.parent) / "streets"  # of all workers
    folder.mkdir(exist_ok=True)

    @lru_cache(maxsize=16)
    def street(shape: tuple[int, int], seed: int) -> np.ndarray:
        file = folder / f"{shape}-{seed}.npy"
        if not file.exists():
            np.save(own / file.name, draw(shape, seed))
            (own / file.name).replace(file)
        return np.load(file)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("photonpano_simulator.scenes.street", street)
        yield


@pytest.fixture(scope="session", autouse=True)
def plugins_found_once() -> Iterator[None]:
    """Find the installed plugins once: each spec and each command looks for them, which takes longer than to read a spec.

    They are looked for anew where a test has others: installed in another folder, disabled, or without their libraries.
    """
    path = list(sys.path)

    def place() -> tuple[Any, ...]:
        folders = [folder for folder in sys.path if folder in path or any(Path(folder).glob("*.dist-info"))]
        return folders, os.environ.get(DISABLE), importlib.util.find_spec

    find, found, installed = registry.discover, registry.discover(), place()
    with pytest.MonkeyPatch.context() as patch:
        for module in ("photonpano.plugins.registry", "photonpano.specs.loading"):
            patch.setattr(f"{module}.discover", lambda: found if place() == installed else find())
        yield


@pytest.fixture
def without_report(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write an empty report in runs of this process: drawing it takes longer than a small run."""
    monkeypatch.setattr("photonpano.pipeline.run.render_report", lambda *_: "<html></html>")
    monkeypatch.setattr("photonpano_poses.run.render_pose_report", lambda *_: "<html></html>")
    monkeypatch.setattr("photonpano.pipeline.run.render_failure", lambda *_: "<html></html>")


def pytest_collection_finish() -> None:
    """Leave the tests and all modules out of garbage collection, which would look through them each time."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown() -> Iterator[None]:
    """Release the lock of numba's compiler, which the error of a timeout can leave locked: later tests would wait for ever."""
    locks = sys.modules.get("numba.core.compiler_lock")
    while locks is not None and locks.global_compiler_lock.is_locked():
        locks.global_compiler_lock.release()
    return (yield)
