"""Help, options, progress, verbosity and completion."""

import errno
import importlib.util
import io
import logging
import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import photonpano
from photonpano.api.cli import progress
from photonpano.api.cli.app import commands
from photonpano.api.cli.progress import Bars, Lines, progress_for_stderr
from photonpano.api.cli.signatures import capture_plan
from photonpano.api.cli.verbosity import is_quiet, is_verbose
from photonpano.api.command import WrongArgumentError
from photonpano.errors import SpecError
from photonpano.execution.context import Quiet

HEAVY = {"numpy", "pydantic", "cv2", "scipy", "skimage", "matplotlib", "rich", "photonpano_core", "photonpano_opencv"}


@pytest.fixture(autouse=True)
def narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


COMMANDS = commands()


def test_help_imports_nothing_heavy(program: list[str]) -> None:
    script = f"import sys, atexit; atexit.register(lambda: print(*sys.modules, file=sys.stderr)); {program[-1]}"
    done = subprocess.run([sys.executable, "-c", script, "--help"], capture_output=True, text=True, check=True)
    assert "Make a panorama from a spec." in done.stdout
    loaded = {module.partition(".")[0] for module in done.stderr.split()}
    assert "typer" in loaded
    assert not loaded & HEAVY


def test_commands_are_complete() -> None:
    words = "run batch check check-run render video verify explain info preview convert export simulate dark evaluate compare"
    groups = {"plugins list", "plugins show"}
    assert set(COMMANDS) == {*words.split(), *groups, "clean", "demo", "schema", "warm-up"}


@pytest.mark.parametrize("name", COMMANDS)
def test_help_explains_every_option_and_its_example_parses(name: str, invoke: Callable[..., Any]) -> None:
    command = COMMANDS[name]
    assert [parameter.name for parameter in command.params if not parameter.help] == []
    words = name.split()
    text = invoke(*words, "--help").stdout
    assert all(len(line) <= 80 for line in text.splitlines())
    examples = [line.split("Example: ")[1] for line in command.help.splitlines() if "Example: " in line]
    assert len(examples) == 1
    program, *arguments = shlex.split(examples[0].partition(" > ")[0])
    assert (program, *arguments[: len(words)]) == ("photonpano", *words)
    with command.make_context(words[-1], arguments[len(words) :]):
        pass


def test_short_help_is_not_cut(invoke: Callable[..., Any]) -> None:
    assert "..." not in invoke("--help").stdout.replace("[ARGS]...", "")
    assert "..." not in invoke("plugins", "--help").stdout.replace("[ARGS]...", "")


def test_version_is_printed(invoke: Callable[..., Any]) -> None:
    assert invoke("--version").stdout == f"photonpano {photonpano.__version__}\n"


@pytest.fixture
def cube(folder: Path) -> Path:
    np.save(folder / "cube.npy", np.zeros((20, 8, 2), np.uint8))
    return folder / "cube.npy"


def test_capture_plan_resolves_path_from_current_folder(cube: Path) -> None:
    with capture_plan(Path("cube.npy")) as plan:
        pass
    assert (plan.source.contribution.name, plan.source.config.path) == ("packed-npy", cube)


def test_capture_plan_reads_option_values_as_yaml(cube: Path) -> None:
    corrections = ["rot90", "{crop: {rows: [2, null]}}"]
    with capture_plan(Path("cube.npy"), "packed-npy", ["frame_rate_hz=1e3", "width=13"], corrections) as plan:
        pass
    assert (plan.source.config.frame_rate_hz, plan.source.config.width) == (1000, 13)
    assert plan.document["corrections"] == ["rot90", {"crop": {"rows": [2, None], "columns": [None, None]}}]


def test_capture_plan_applies_options_to_spec(cube: Path) -> None:
    Path("scan.yml").write_text("version: 1\nsource: {use: auto, with: {path: cube.npy, frame_rate_hz: 7}}\nlevels: 2\n")
    with capture_plan(Path("scan.yml"), None, ["width=13"], ["rot90"]) as plan:
        pass
    assert (plan.source.config.frame_rate_hz, plan.source.config.width, len(plan.levels)) == (7, 13, 2)
    assert plan.document["corrections"] == ["rot90"]
    with pytest.raises(SpecError), capture_plan(Path("scan.yml"), "nobody"):
        pass


def test_missing_library_of_recognised_source_names_no_option(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *args: None if name == "av" else found(name, *args))
    (folder / "film.mp4").write_bytes(b"....ftypisom")
    with pytest.raises(WrongArgumentError) as caught, capture_plan(Path("film.mp4")):
        pass
    assert str(caught.value).startswith("the source 'video' needs av, which is not installed: pip install ")


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stderr", "environment", "expected"),
    [
        (io.StringIO(), {"TERM": "xterm"}, Lines),
        (Terminal(), {"TERM": "xterm"}, Bars),
        (Terminal(), {"TERM": "dumb"}, Lines),
        (Terminal(), {"TERM": "xterm", "JPY_PARENT_PID": "1"}, Lines),
    ],
    ids=["pipe", "terminal", "dumb terminal", "cell of a notebook"],
)
def test_progress_draws_bars_only_on_terminal(
    monkeypatch: pytest.MonkeyPatch, stderr: io.StringIO, environment: dict[str, str], expected: type
) -> None:
    monkeypatch.setattr("sys.stderr", stderr)
    monkeypatch.delenv("JPY_PARENT_PID", raising=False)
    for name, value in {"FORCE_COLOR": "1", **environment}.items():
        monkeypatch.setenv(name, value)
    assert isinstance(progress_for_stderr(), expected)


def test_bar_shows_stage_count_and_rate() -> None:
    screen = io.StringIO()
    bars = Bars(Console(file=screen, width=100, force_terminal=True, color_system=None))
    with bars.stage("level 2: locate [all]", 1200, "exposures") as advance:
        advance(600)
        advance(600)
    *_, last = screen.getvalue().split("level 2: locate [all]")
    assert "1200/1200" in last
    assert "exposures/s" in last


def test_note_is_printed_unchanged() -> None:
    screen = io.StringIO()
    bars = Bars(Console(file=screen, width=20, force_terminal=True, color_system=None, markup=False, highlight=False))
    bars.note("level 1: [bold] " + "a long line " * 5)
    assert screen.getvalue() == "level 1: [bold] " + "a long line " * 5 + "\n"


def test_line_is_printed_at_each_interval_and_none_for_short_stage(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "INTERVAL_S", 0.2)
    monkeypatch.setattr(progress, "_LEAST_S", 0.1)
    lines = Lines()
    for _ in range(3):
        with lines.stage("short", 1, "frames") as advance:
            advance(1)
    with lines.stage("level 2: locate", 1200, "exposures") as advance:
        advance(1)  # the first takes longer, for loops are compiled, and says nothing of the others
        time.sleep(0.3)
        advance(399)
        time.sleep(0.5)
        advance(800)
    lines.note("level 2: done")
    first, *later = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"level 2: locate: 1 of 1,200 exposures after [\d.]+ (s|ms)", first)
    after_400 = [line for line in later if line.startswith("level 2: locate: 400 of 1,200 exposures after ")]
    assert after_400
    assert after_400[-1].endswith(" left")


def test_progress_survives_closed_standard_error(monkeypatch: pytest.MonkeyPatch) -> None:
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    monkeypatch.setattr("sys.stderr", Closed())
    lines = Lines(notes=True, stages=True)
    with lines.stage("level 1", 1, "exposures") as advance:
        advance(1)
    lines.note("level 1: done")


SIMULATE = ("simulate", "capture.yaml", "--output", "cube.npy", "--set", "source.with.n_frames=40")


@pytest.fixture(autouse=True)
def nothing_stays() -> Any:
    """What a command says ends with it."""
    yield
    assert not is_quiet()
    assert not is_verbose()
    logger = logging.getLogger("photonpano")
    assert (logger.handlers, logger.level) == ([], logging.NOTSET)


TIMES = re.compile(r"^(.*?) +([\d.]+) +.*%$")  # a row: title, seconds


@pytest.mark.parametrize("place", ["before the command", "after it"])
@pytest.mark.usefixtures("folder")
def test_verbose_prints_each_stage(invoke: Callable[..., Any], place: str) -> None:
    result = invoke("-v", *SIMULATE) if place == "before the command" else invoke(*SIMULATE, "-v")
    assert re.fullmatch(r"writing cube\.npy: 40 frames in [\d.]+ m?s\n", result.stderr)


def test_verbose_prints_decisions_of_run(folder: Path, invoke: Callable[..., Any], finished: Path) -> None:
    text = (finished / "run.yaml").read_text().replace("cube.npy", str(finished / "cube.npy"))
    (folder / "run.yaml").write_text(text.replace("{with: {group_size: 50}}", "{with: {group_size: auto}}"))
    result = invoke("run", "run.yaml", "-v", "--log", "run.log")
    assert re.search(r"^group_size \d+: at ", result.stderr, re.MULTILINE)
    assert re.search(r"^took [\d.]+ m?s", result.stderr, re.MULTILINE)
    header, *rows = result.stderr.partition("\nstage ")[2].splitlines()
    assert header.split("  ")[-1] == "share"
    found = [TIMES.findall(row)[0] for row in rows]
    times = {title.split(" (")[0]: float(seconds) for title, seconds in found}
    assert next(iter(times)) == "level 1: merge and locate"
    assert list(times)[-2:] == ["other", "whole"]
    assert {"panorama", "residuals"} <= set(times)
    *parts, whole = times.values()
    assert sum(parts) == pytest.approx(whole, abs=0.01 * len(parts)), "parts do not add up to the whole"
    log = (folder / "run.log").read_text()
    assert all(line in log for line in result.stderr.splitlines() if not re.search(r" in [\d.]+ m?s$", line))


def test_quiet_keeps_results_warnings_and_errors(
    folder: Path, invoke: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    from photonpano.api.cli.progress import progress_for_stderr

    shown = []
    monkeypatch.setattr("photonpano.api.cli.progress._progress_for_stderr", lambda _: shown.append(is_quiet()) or Quiet())
    assert "40 binary frames" in invoke("-q", *SIMULATE).stdout
    assert shown == [True]
    assert isinstance(progress_for_stderr(), Quiet)
    assert invoke("run", "nowhere.yaml", "-q").stderr == (
        f"{Path('nowhere.yaml')}: there is no such file\nerror: the spec has 1 problem\n"
    )
    assert not (folder / "runs").exists()


def test_log_is_appended_to_and_holds_stages_and_errors(folder: Path, invoke: Callable[..., Any]) -> None:
    done = invoke(*SIMULATE, "--log", "night.log")
    assert (done.exit_code, done.stderr) == (0, "")
    failed = invoke("run", "nowhere.yaml", "--log", "night.log")
    assert failed.exit_code == 2
    lines = (folder / "night.log").read_text().splitlines()
    times, levels, messages = zip(*(re.fullmatch(r"(\S+ \S+) (\w+) +(.*)", line).groups() for line in lines), strict=True)
    assert sorted(times) == list(times)
    assert levels == ("INFO", "INFO", "INFO", "INFO", "ERROR")
    assert messages[1] == "writing cube.npy: begins"
    assert messages[2].startswith("writing cube.npy: 40 frames in ")
    assert messages[4] == "nowhere.yaml: there is no such file"


class FullDisk(io.RawIOBase):
    """A file on a disk without room."""

    def writable(self) -> bool:
        return True

    def write(self, _: Any) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_full_disk_ends_log_and_not_the_command(
    folder: Path, invoke: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(logging.FileHandler, "_open", lambda _: io.TextIOWrapper(io.BufferedWriter(FullDisk()), "utf-8"))
    result = invoke(*SIMULATE, "--log", "night.log")
    reason = f"OSError: [Errno {errno.ENOSPC}] No space left on device"
    assert (result.exit_code, result.stderr) == (0, f"warning: the log {folder / 'night.log'} ends here: {reason}\n")


COMPLETES = """
import os, sys
from photonpano.api.cli import main
for words in sys.argv[1:]:
    process = os.fork()
    if process == 0:
        os.environ |= {"COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
        sys.argv[1:] = []
        main()
    os.waitpid(process, 0)
"""


def test_shell_completes_commands_components_and_options() -> None:
    asked = ["photonpano check-", "photonpano info --source packed-n", "photonpano run --keep"]
    completing = os.environ | {"_PHOTONPANO_COMPLETE": "complete_bash"}
    done = subprocess.run([sys.executable, "-c", COMPLETES, *asked], env=completing, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["check-run", "packed-npy", "--keep-work"]
