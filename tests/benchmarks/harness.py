"""What benchmarks and makers of figures share: captures and runs that are kept, scores, costs, tables in pages, and options."""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML

from photonpano import Catalog, FrameSpan, Panorama, Plan, Source, evaluate, load_panorama, open_source, parse_spec, run
from photonpano.capture.writing import truth_path, write_packed
from photonpano.evaluation import (
    Evaluation,
    RunTrajectory,
    TrajectoryScore,
    Truth,
    corner_errors,
    image_score,
    load_run_trajectory,
    load_truth,
    true_panorama,
    white_flux,
)
from photonpano.execution.context import Context
from photonpano.geometry import Canvas, FrameTrajectory, normalised, transform_points
from photonpano.merging.panorama import plan_canvas, render
from photonpano.reading import Closing
from photonpano.record.run_json import peak_memory_bytes

sys.path.append(str(Path(__file__).parent / "baselines"))

EXAMPLES = Path(__file__).parents[2] / "examples"
IMAGES = Path(__file__).parents[2] / "docs" / "images"
RATE_HZ = 96_800
HELD_FRAMES = 10_000


def simulator(use: str = "simulator", **camera: Any) -> dict[str, Any]:
    """Return a spec whose source simulates a capture."""
    return {"version": 1, "source": {"use": use, "with": camera}}


def packed(cube: Path, rate_hz: float | None = RATE_HZ, **sections: Any) -> dict[str, Any]:
    """Return the spec of a run of a capture that was written."""
    source = {"use": "packed-npy", "with": {"path": str(cube.absolute()), "frame_rate_hz": rate_hz}}
    return {"version": 1, "source": source, **sections}


def groups(size: int | str) -> dict[str, Any]:
    """Return the section `resample` of a group size."""
    return {"use": "midpoint", "with": {"group_size": size}}


def hand_held(frame_shape: tuple[int, int]) -> dict[str, Any]:
    """Return a spec that simulates a trembling hand before the street, in `HELD_FRAMES` frames."""
    return simulator(
        scene={"kind": "street", "width": 2048, "height": 1365},
        path={"kind": "random-spline", "length_px": 200, "shake": {"rms_px": 2.0, "frequencies_hz": [25, 120, 400]}},
        flux=0.3,
        n_frames=HELD_FRAMES,
        frame_shape=list(frame_shape),
    )


def seen(scene: NDArray[Any], to_scene: NDArray[np.float64], shape: Sequence[int]) -> NDArray[np.float32]:
    """Return what a frame of a shape sees of a scene, interpolated linearly, without the light from beyond it."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpPerspective(scene, to_scene, (shape[1], shape[0]), flags=flags), np.float32)


@dataclass(frozen=True)
class Study:
    """A folder of captures and runs, which are used again: those of other specs have other names.

    Attributes:
        folder: for captures and runs.
        quick: whether captures are small: some hundreds of frames.
    """

    folder: Path
    quick: bool = False

    def spec(self, name: str, changes: Mapping[str, Any] = {}, quick: Mapping[str, Any] = {}) -> dict[str, Any]:
        """Return a spec of examples with changes, by keys with dots, and with those of the quick study if this is one."""
        spec: dict[str, Any] = YAML(typ="safe").load((EXAMPLES / f"{name}.yaml").read_text(encoding="utf-8"))
        for key, value in {**changes, **(quick if self.quick else {})}.items():
            *parents, last = key.split(".")
            section = spec
            for parent in parents:
                section = section.setdefault(parent, {})
            section[last] = value
        return spec

    def capture(self, name: str, spec: Mapping[str, Any]) -> Path:
        """Return the capture that the source of a spec simulates, with its truth beside it."""
        path = self.folder / f"{name.replace(' ', '-')}-{digest(spec['source'])}.npy"
        if not truth_path(path).exists():
            with open_source(parse_spec({"version": 1, "source": spec["source"], "corrections": []})) as source:
                write_packed(source, path)
        return path

    def run(self, name: str, spec: Mapping[str, Any], capture: Path | None = None) -> Path:
        """Run a spec, on a capture that its source has simulated, and return the run folder."""
        if capture is not None:
            rate = spec["source"]["with"].get("frame_rate_hz", RATE_HZ)
            spec = {**spec, "source": packed(capture, rate)["source"]}
        folder = self.folder / f"{name.replace(' ', '-')}-{digest(spec)}"
        if not (folder / "run.json").exists():
            run(parse_spec(spec, output=folder, catalog=with_baselines()))
        return folder


def with_baselines() -> Catalog:
    """Return what the installed plugins and the baselines offer."""
    import photonpano_baselines

    return photonpano_baselines.catalog()


@contextmanager
def passing(folder: Path | None = None) -> Iterator[Study]:
    """Lend a study that is removed afterwards, in a folder for temporary files."""
    with tempfile.TemporaryDirectory(dir=folder, ignore_cleanup_errors=True) as place:
        yield Study(Path(place))


def digest(content: object) -> str:
    """Return eight characters that differ for other contents."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]


def record_of(folder: Path) -> dict[str, Any]:
    """Return the record of a run."""
    record: dict[str, Any] = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    return record


def scores_of(folder: Path, capture: Path, oracle: bool = True) -> Evaluation:
    """Return the scores of a run against the truth beside its capture."""
    return evaluate(folder, truth_path(capture), oracle)


@dataclass(frozen=True)
class Compared:
    """A run beside the truth of its capture.

    Attributes:
        folder: of the run.
        found: the motion.
        truth: motion and scene.
        score: errors of the motion.
    """

    folder: Path
    found: RunTrajectory
    truth: Truth
    score: TrajectoryScore

    @classmethod
    def of(cls, folder: Path, capture: Path) -> Compared:
        """Read a run, and the truth beside its capture."""
        found, truth = load_run_trajectory(folder), load_truth(truth_path(capture))
        return cls(
            folder, found, truth, corner_errors(found.homographies, truth.homographies, found.frame_shape, found.located)
        )

    @property
    def panorama(self) -> Panorama:
        """The panorama of the run."""
        return load_panorama(self.folder)

    @property
    def canvas(self) -> Canvas:
        """The pixels of the panorama."""
        return self.found.canvas_of(self.panorama.flux.shape[:2])

    @property
    def motion(self) -> FrameTrajectory:
        """The motion of every frame, to the reference."""
        return FrameTrajectory(self.found.homographies)

    def scene(self, canvas: Canvas, alignment: NDArray[np.float64] | None = None) -> NDArray[np.float32]:
        """Return the true scene on a canvas: (H, W) flux; aligned as the motion of all frames by default."""
        assert self.truth.scene is not None
        return true_panorama(self.truth.scene, canvas, self.score.alignment if alignment is None else alignment)

    def psnr_db(self, flux: NDArray[np.float32], scene: NDArray[np.float32], where: NDArray[np.bool_]) -> float:
        """Return the PSNR of flux on a canvas where it is compared."""
        assert self.truth.scene is not None
        return image_score(flux, scene, where, white_flux(self.truth.scene)).psnr_db

    def finer(self) -> tuple[Panorama, NDArray[np.float32]]:
        """Merge the capture on the canvas of the run, and at the resolution of the sensor, interpolated to that canvas."""
        canvas, flags = self.canvas, cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        with self.source() as source:
            coarse, merged = rendered(source, self.motion), rendered(source, self.motion, canvas)
        to_small = coarse.canvas @ np.linalg.inv(canvas.transform)
        return merged, cv2.warpPerspective(np.nan_to_num(coarse.flux), to_small, canvas.shape[::-1], flags=flags)

    @property
    def plan(self) -> Plan:
        """The spec of the run."""
        return parse_spec(record_of(self.folder)["spec"], catalog=with_baselines())

    @contextmanager
    def source(self) -> Iterator[Source]:
        """Open the capture again, as the run has read it."""
        with open_source(self.plan) as source:
            yield source

    def middles(self, true: bool = False) -> NDArray[np.float64]:
        """Return where the middle of each frame lies in the reference plane: (T, 2); or where truly, on the true plane."""
        return middles(self.truth.homographies if true else self.found.homographies, self.found.frame_shape)

    def aligned_middles(self) -> NDArray[np.float64]:
        """Return where the middle of each frame lies in the true plane, as the run has found it: (T, 2)."""
        return middles(self.score.alignment @ self.found.homographies, self.found.frame_shape)


def middles(homographies: NDArray[np.float64], frame_shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return where homographies, (T, 3, 3), put the middle of a frame: (T, 2)."""
    return transform_points(homographies, (np.array([frame_shape[::-1]]) - 1) / 2)[:, 0]


def rendered(source: Source, motion: FrameTrajectory, canvas: Canvas | None = None, tolerance_px: float = 0.125) -> Panorama:
    """Render a capture along a motion; on a canvas that holds all of it by default."""
    span = source.info.span
    canvas = canvas or plan_canvas(motion, span, source.info.frame_shape, 1.0, 2**31)
    return render(source, motion, span, canvas, tolerance_px, Context(threads=2))


def to_reference(homographies: NDArray[np.float64], reference: int | None = None) -> NDArray[np.float64]:
    """Return a motion relative to one of its frames, by default that in the middle."""
    fixed = homographies[len(homographies) // 2 if reference is None else reference]
    return normalised(np.linalg.inv(fixed) @ homographies)


class Expected(Closing):
    """A source without noise: what is expected in place of the photons of another.

    Args:
        like: the source that has photons.
        chance: returns the probability that each pixel of a frame is lit: (H, W).
    """

    def __init__(self, like: Source, chance: Callable[[int], NDArray[Any]]) -> None:
        self.info, self.response, self.valid, self._chance = like.info, like.response, like.valid, chance

    def counts(self, span: FrameSpan) -> Any:
        """Sum the probabilities of a span."""
        total = sum(self._chance(index).astype(np.float64) for index in range(span.start, span.stop))
        return np.asarray(total, np.float32)


class Cost(NamedTuple):
    """What a call took: its result, seconds, seconds of the processor, and the largest memory of its process so far, in MiB."""

    result: Any
    seconds: float
    processor_s: float
    peak_mib: float


def took(work: Callable[..., Any], *given: Any, clock: Callable[[], float] = time.process_time) -> Cost:
    """Call a function, and return what it took, by a clock of the processor."""
    start, worked = time.perf_counter(), clock()
    result = work(*given)
    return Cost(result, time.perf_counter() - start, clock() - worked, peak_memory_bytes() / 2**20)


def least(work: Callable[..., Any], *given: Any, times: int = 3, clock: Callable[[], float] = time.process_time) -> Cost:
    """Call a function several times, and return the least that it took."""
    costs = [took(work, *given, clock=clock) for _ in range(times)]
    return Cost(costs[-1].result, *(min(each[index] for each in costs) for index in (1, 2)), costs[-1].peak_mib)


def in_child(work: Callable[..., Any], *given: Any) -> Cost:
    """Call a function in a process of its own, and return what it took there; what it raises is raised here."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(took, work, *given).result()


def table(head: Sequence[str], rows: Iterable[Iterable[object]]) -> list[str]:
    """Return the lines of a table in Markdown, and print each when its row is known."""
    lines = []
    for cells in (row for part in ([head, ["---"] * len(head)], rows) for row in part):
        lines.append(f"| {' | '.join(str(cell) for cell in cells)} |")
        print(lines[-1], flush=True)
    return lines


def chosen(words: Sequence[str], names: Iterable[str]) -> list[str]:
    """Return the names that are one of some words, or contain a word that is no name itself; all without words."""
    names = list(names)
    found: set[str] = set() if words else set(names)
    for word in words:
        meant = {word} & set(names) or {name for name in names if word in name}
        if not meant:
            raise SystemExit(f"nothing is called {word}; there are {', '.join(names)}")
        found |= meant
    return [name for name in names if name in found]


def filled(text: str, name: str, lines: Iterable[str]) -> str:
    """Return the text of a page with other lines between the two comments that mark the place of a table."""
    begin, end = _marks(name)
    before, rest = text.split(begin)
    return "\n".join([f"{before}{begin}", *lines, end]) + rest.split(end)[1]


def write_tables(page: Path | None, tables: Mapping[str, Iterable[str]]) -> None:
    """Replace tables of a page, each given by its name and its lines; without a page, they have been printed."""
    if page is None:
        return
    text = page.read_text(encoding="utf-8")
    for name, lines in tables.items():
        text = filled(text, name, lines)
    page.write_text(text, encoding="utf-8")


def _marks(name: str) -> tuple[str, str]:
    return f"<!-- {name}: begin -->", f"<!-- {name}: end -->"


def command(main: Callable[..., object], *tables: str) -> None:
    """Run the function of a script with the options of the command line, and exit with what it returns.

    Its keyword arguments are options, of the types of their defaults (lists take several values; None stands for a path); its
    other arguments are paths, and `page` is optional: the page of the docs whose `tables` are replaced, which must have their
    places before hours are spent on measuring them.
    """
    parser = argparse.ArgumentParser(
        description=main.__globals__["__doc__"], formatter_class=argparse.RawDescriptionHelpFormatter
    )
    positional: list[str] = []
    for name, parameter in inspect.signature(main).parameters.items():
        default, flag = parameter.default, f"--{name.replace('_', '-')}"
        if parameter.kind is parameter.VAR_POSITIONAL or default is parameter.empty or name == "page":
            positional.append(name)
            many = {"nargs": "+"} if parameter.kind is parameter.VAR_POSITIONAL else {"nargs": "?"} if name == "page" else {}
            parser.add_argument(name, type=Path, **many)
        elif isinstance(default, bool):
            parser.add_argument(flag, action="store_true")
        elif isinstance(default, list | tuple):
            parser.add_argument(flag, nargs="*", type=type(default[0]) if default else str, default=list(default))
        else:
            parser.add_argument(flag, type=Path if default is None else type(default), default=default)
    given = vars(parser.parse_args())
    text = given["page"].read_text(encoding="utf-8") if given.get("page") else ""
    for begin, end in map(_marks, tables if text else ()):
        if not 0 <= text.find(begin) < text.find(end):
            raise SystemExit(f"{given['page']}: a table has no place; mark it with {begin} and {end}")
    paths = [given.pop(name) for name in positional]
    sys.exit(main(*(path for each in paths for path in (each if isinstance(each, list) else [each])), **given))
