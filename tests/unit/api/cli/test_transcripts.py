"""Commands and what they print, as in `transcripts/*.txt`.

A line `$ photonpano ...` is a command. Below it are the lines of standard output, those of standard error after `! `, and the
exit code in brackets unless it is 0. `...` stands for anything; alone on a line, for any number of lines. `{here}` is the
current folder, and `photonpano 0.1.0` the installed version. `% NAME` calls a function of `SET_UPS`, `> FILE` writes the lines
up to `<` to a file, `$ ls` lists files, and `## ` begins a comment. With `TRANSCRIPTS=write` in the environment, what differs
is written anew.
"""

import json
import os
import re
import shlex
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from pydantic import Field

from photonpano import (
    Config,
    FrameSpan,
    LocatorContribution,
    Requirement,
    RunCheck,
    SourceContribution,
    SpecPath,
    StreamInfo,
    discover,
    hookimpl,
)
from photonpano.api.batch_jobs import Job
from photonpano.api.cli.app import commands
from photonpano.api.command import COMMANDS
from photonpano.photometry import IntensityResponse
from photonpano.pipeline.run import RunResult
from photonpano.plugins.registry import BrokenPlugin, Catalog, DisabledPlugin, Observer, Origin, make_entry, observation_of
from photonpano.values import Reason, Verdict

INSTALLED = f"photonpano {version('photonpano')}"
TRANSCRIPTS = sorted((Path(__file__).parent / "transcripts").glob("*.txt"))
TREMBLING = Reason("the image moves within groups", 24.1, 2.0, "scatter of the shifts over their noise", "use smaller groups")
TRUSTED, DOUBTFUL = Verdict("trusted", (), 1.0), Verdict("doubtful", (TREMBLING,), 24.123)


@dataclass
class World:
    """What set-ups change."""

    finished: Path
    patch: pytest.MonkeyPatch
    clouds: Callable[..., np.ndarray]

    def answer(self, name: str, result: Any) -> None:
        """Let a command have a result without work."""
        commands()[name]  # imports its module
        self.patch.setitem(COMMANDS, name, replace(COMMANDS[name], calls=lambda **_: result))

    def runs(self, verdict: Verdict, *others: Verdict, **record: Any) -> None:
        """Let `run` have a verdict, and those of other shots of 120 frames."""
        refined = {"use": "short-spans", "rounds": ["tremor at 223 Hz", "less"], "change_px": 0.664, "kept_out": None}
        still = {"use": "other", "rounds": [], "change_px": 0.0, "kept_out": None}
        found = {"warnings": ["a warning"], "refinements": [refined, still], "decisions": [], "files": {"report.html": {}}}
        shot = found | {"source": {"n_frames": 120}, "warnings": []}
        shots = [RunResult(Path(f"run.panorama-{n}").absolute(), shot, each) for n, each in enumerate(others, start=2)]
        result = RunResult(Path("run").absolute(), found | record, verdict, others=tuple(shots))
        self.patch.setattr("photonpano.api.run.run", lambda *_, **_options: result)

    def batches(self) -> None:
        """Let a run of a batch called `bad` fail, one of `odd` be doubtful, and others be trusted."""

        def rows_of(jobs: Sequence[Job], n_workers: int) -> Any:
            for index, job in enumerate(jobs):
                yield [(index, replace(job.row, status="running"))]
                assert Path("out/summary.csv").read_text().count(",running,") == 1
                verdict = "doubtful" if job.row.name == "odd" else "trusted"
                done = replace(
                    job.row, status="done", verdict=verdict, n_frames=200, expected_error_px=0.123, seconds=n_workers
                )
                failed = replace(job.row, status="failed", reason="cut short\ncopy it again")
                yield [(index, failed if job.row.name == "bad" else done)]

        self.patch.setattr("photonpano.api.batch.rows_of", rows_of)
        Path("scan.yaml").write_text("version: 1\nsource: {use: auto}\nresample: {with: {group_size: 25}}\n")
        Path("list.txt").write_text("good.npy\n")
        for name in ("good", "odd"):
            np.save(f"{name}.npy", np.zeros((200, 64, 12), np.uint8))

    def run(self) -> None:
        """Copy a capture with its truth, and its run."""
        for name in ("cube.npy", "cube.truth.npz"):
            shutil.copy2(self.finished / name, name)
        shutil.copytree(self.finished / "run", "run")
        here = str(Path("cube.npy").absolute())
        self.record(lambda record: record["spec"]["source"]["with"].update(path=here))
        self.record(lambda record: record["capture"]["files"][0].update(path=here))

    def record(self, change: Callable[[dict[str, Any]], object]) -> None:
        """Change the record of the run."""
        record = json.loads(Path("run/run.json").read_text())
        change(record)
        Path("run/run.json").write_text(json.dumps(record))

    def trajectory(self, **arrays: np.ndarray | None) -> None:
        """Replace arrays of the trajectory, or leave them out."""
        with np.load("run/trajectory.npz") as archive:
            kept = {**archive, **arrays}
        np.savez("run/trajectory.npz", **{name: array for name, array in kept.items() if array is not None})

    def covered(self) -> None:
        """Write frames of a covered camera."""
        rng = np.random.default_rng(0)
        rates = np.where(rng.random((24, 32)) < 0.03, 0.5, 0.002)
        np.save("covered.npy", np.packbits(rng.random((1000, 24, 32)) < -np.expm1(-rates), axis=-1))

    def catalog(self, catalog: Catalog) -> None:
        """Discover these plugins alone."""
        self.patch.setattr("photonpano.plugins.registry.discover", lambda: catalog)


class Keys(Config):
    ratio: float = Field(0.8, gt=0, description="how far")


def locator(name: str, *requires: Requirement) -> LocatorContribution:
    return LocatorContribution(name=name, summary="A toy", config=Keys, build=lambda *_: None, requires=requires)


def odd_catalog() -> Catalog:
    rows = [make_entry(locator("twice"), Origin(plugin, "2.0", f"{plugin} = {plugin}.hooks")) for plugin in ("alpha", "beta")]
    far = locator("far", Requirement("no_such_library", "gamma[far]"))
    rows.append(make_entry(far, Origin("gamma", "1.0", "g = gamma.hooks")))
    broken = BrokenPlugin(Origin("delta", "0.3", "d = delta.hooks"), "ImportError: no module named [delta]")
    disabled = DisabledPlugin(Origin("epsilon", "0.4", "e = epsilon.hooks"), "PHOTONPANO_DISABLE_PLUGINS=e")
    plugin = ModuleType("zeta")
    plugin.photonpano_run_started = plugin.photonpano_run_finished = hookimpl(lambda: None)
    observer = Observer(Origin("zeta", "0.5", "z = zeta.hooks"), observation_of(plugin))
    return Catalog(tuple(rows), (broken,), (disabled,), (observer,))


class GreyConfig(Config):
    path: SpecPath = Field(description="the capture")


class Grey:
    info = StreamInfo(5, 6, 19, None, "intensity", 8)
    valid = np.ones((6, 19), bool)
    response = IntensityResponse(1, 0, 255, 1)

    def counts(self, span: FrameSpan) -> np.ndarray:
        return np.zeros((6, 19), np.uint32)

    def frames(self, span: FrameSpan) -> np.ndarray:
        return np.zeros((len(span), 6, 19), np.uint8)

    def close(self) -> None:
        pass


def with_grey() -> Catalog:
    return discover().including(SourceContribution(name="grey", summary="Toy", config=GreyConfig, build=lambda *_: Grey()))


def pattern() -> None:
    pixels = np.full((96, 160, 3), 255, np.uint8)
    pixels[::2, ::2, 1:] = 0
    np.save("pattern.npy", pixels)


def full_disk(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("photonpano.capture.writing._BLOCK_BYTES", 96 * 20)
    patch.setattr(Path, "write_bytes", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))


def hot() -> np.ndarray:
    rng = np.random.default_rng(0)
    frames = rng.random((600, 64, 64)) < 0.1
    frames[:, rng.random((64, 64)) < 0.02] = True
    frames[:, :8] = True
    return np.packbits(frames, axis=-1)


def save(array: np.ndarray, name: str = "cube.npy") -> None:
    np.save(name, array)


RANGE = {"dynamic_range_db": 71.2, "measurable_range_db": 99.9, "saturated_share": 0.012}
START = {"what": "start", "value": "a turn by 3 degrees a frame", "reason": "it stands out"}
SIZE = {"what": "group_size", "value": 50, "reason": "chosen"}
SET_UPS: dict[str, Callable[[World], object]] = {
    "cube": lambda world: shutil.copy(world.finished / "cube.npy", "cube.npy"),
    "run": World.run,
    "covered": World.covered,
    "batches": World.batches,
    "out-is-a-file": lambda _: Path("out").touch(),
    "out-has-another-summary": lambda _: (Path("out").mkdir(), Path("out/summary.csv").touch()),
    "trusted": lambda world: world.runs(TRUSTED, panorama=RANGE, decisions=[START, SIZE], findings={"start": START}),
    "doubtful": lambda world: world.runs(DOUBTFUL),
    "three-shots": lambda world: world.runs(DOUBTFUL, TRUSTED, DOUBTFUL),
    "check-run-doubtful": lambda world: world.answer("check-run", RunCheck(DOUBTFUL)),
    "check-run-unknown": lambda world: world.answer("check-run", RunCheck(replace(DOUBTFUL, residual_ratio=None))),
    "warm": lambda world: world.answer("warm-up", 31.4),
    "odd-catalog": lambda world: world.catalog(odd_catalog()),
    "grey": lambda world: world.catalog(with_grey()),
    "pattern": lambda _: pattern(),
    "full-disk": lambda world: full_disk(world.patch),
    "opencw-disabled": lambda world: world.patch.setenv("PHOTONPANO_DISABLE_PLUGINS", "opencw"),
    "opencv-disabled": lambda world: world.patch.setenv("PHOTONPANO_DISABLE_PLUGINS", "opencv"),
    "debug": lambda world: world.patch.setenv("PHOTONPANO_DEBUG", "1"),
    "small": lambda _: save(np.zeros((20, 8, 2), np.uint8)),
    "two-frames": lambda _: save(np.zeros((2, 4, 1), np.uint8)),
    "dark": lambda _: save(np.zeros((600, 32, 4), np.uint8)),
    "bright": lambda _: save(np.full((600, 32, 4), 255, np.uint8)),
    "hot": lambda _: save(hot()),
    "five-frames": lambda _: save(np.random.default_rng(0).integers(0, 256, (5, 32, 4), np.uint8)),
    "little": lambda world: save(np.packbits(world.clouds(), axis=1, bitorder="little")),
    "wrong-order": lambda world: save(np.packbits(world.clouds(), axis=2, bitorder="little")),
    "unpacked": lambda world: save(world.clouds()),
    "sums": lambda world: save(world.clouds().reshape(96, 4, 64, 96).sum(axis=1)),
    "large": lambda _: save(np.zeros((2**15, 8, 8), np.uint8), "large.npy"),
    "mask": lambda _: save(np.zeros((24, 32), bool), "mask.npy"),
    "recorded": lambda _: save(np.zeros((4, 8, 2), np.uint8), "recorded.npy"),
    "folder-of-pictures": lambda _: (Path("pictures").mkdir(), Path("pictures/a.png").write_bytes(b"no picture")),
    "taken": lambda _: [(Path(name).mkdir(), Path(name, "mine").touch()) for name in ("taken.zarr", "b.sharp")],
    "other-frames": lambda _: save(np.load("cube.npy")[:, ::-1]),
    "fewer-frames": lambda _: save(np.load("cube.npy")[:199]),
    "smaller-frames": lambda _: save(np.load("cube.npy")[:, :90]),
    "no-capture": lambda _: Path("cube.npy").unlink(),
    "no-record": lambda _: Path("run/run.json").unlink(),
    "other-trajectory": lambda world: world.trajectory(std_px=np.zeros(200)),
    "no-hashes": lambda world: world.record(lambda record: record.pop("files")),
    "nothing-located": lambda world: (
        world.record(lambda record: record.pop("files")),
        world.trajectory(located=np.zeros(200, np.bool_)),
    ),
    "no-rate": lambda world: world.record(lambda record: record["spec"]["source"]["with"].pop("frame_rate_hz")),
    "other-vignette": lambda _: np.savez(
        "run/vignette.npz", gain=np.ones((3, 4), np.float32), mean=np.ones((3, 4), np.float32)
    ),
    "no-report": lambda _: Path("run/report.html").unlink(),
}


@pytest.mark.parametrize("path", TRANSCRIPTS, ids=lambda path: path.stem)
def test_commands_print_what_is_written(
    path: Path,
    folder: Path,
    finished: Path,
    clouds: Callable[..., np.ndarray],
    invoke: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("photonpano.api.cli.progress.INTERVAL_S", 3600.0)
    shown, wrong = [], []
    text = path.read_text(encoding="utf-8")
    for number, story in enumerate(re.split(r"^## ", text, flags=re.MULTILINE)):
        title, _, steps = story.partition("\n")
        shown.append(f"\n## {title}" if number else title)
        for file in folder.iterdir():
            if file.name != "capture.yaml":
                shutil.rmtree(file) if file.is_dir() else file.unlink()
        with monkeypatch.context() as patch:
            world = World(finished, patch, clouds)
            for step in re.split(r"^(?=[$%>] )", steps, flags=re.MULTILINE):
                head, _, body = step.partition("\n")
                if head.startswith("% "):
                    SET_UPS[head[2:]](world)
                elif head.startswith("> "):
                    Path(head[2:]).write_text(body.partition("<\n")[0], encoding="utf-8")
                elif head.startswith("$ "):
                    found = output_of(shlex.split(head[2:]), invoke).replace(str(folder), "{here}")
                    found = found.replace(INSTALLED, "photonpano 0.1.0")
                    if not pattern_of(body.strip("\n")).fullmatch(f"{found}\n"):
                        wrong.append(f"{path.name}: {head}\n--- written\n{body}\n--- found\n{found}")
                        step = f"{head}\n{found}"
                shown += [step.strip("\n")] if step.strip() else []
    if os.environ.get("TRANSCRIPTS") == "write":
        path.write_text("\n".join(shown).strip("\n") + "\n", encoding="utf-8")
    assert not wrong, "\n\n".join(wrong)


def output_of(words: Sequence[str], invoke: Callable[..., Any]) -> str:
    """Return what a command prints, and its exit code if it is not 0."""
    if words[0] == "ls":
        return "\n".join(sorted(path.name for path in Path.cwd().iterdir() if path.name != "capture.yaml"))
    done = invoke(*words[1:])
    errors = "".join(f"! {line}\n" for line in done.stderr.splitlines())
    return f"{done.stdout}{errors}{f'[{done.exit_code}]' if done.exit_code else ''}".strip("\n")


def pattern_of(written: str) -> re.Pattern[str]:
    """Return a pattern in which `...` stands for anything in a line, and alone in a line for any lines."""
    lines = (
        "(?:.*\n)*?" if line == "..." else ".*".join(map(re.escape, line.split("..."))) + "\n" for line in written.split("\n")
    )
    return re.compile("".join(lines))
