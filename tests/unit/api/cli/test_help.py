"""Help, options, progress, verbosity and completion."""

import io
import logging
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano.api.cli.app import commands
from photonpano.api.cli.progress import Bars, Lines, progress_for_stderr
from photonpano.api.cli.verbosity import is_quiet, is_verbose
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


@pytest.fixture
def cube(folder: Path) -> Path:
    np.save(folder / "cube.npy", np.zeros((20, 8, 2), np.uint8))
    return folder / "cube.npy"


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


SIMULATE = ("simulate", "capture.yaml", "--output", "cube.npy", "--set", "source.with.n_frames=40")


@pytest.fixture(autouse=True)
def nothing_stays() -> Any:
    """What a command says ends with it."""
    yield
    assert not is_quiet()
    assert not is_verbose()
    logger = logging.getLogger("photonpano")
    assert (logger.handlers, logger.level) == ([], logging.NOTSET)


def test_verbose_prints_decisions_of_run(folder: Path, invoke: Callable[..., Any], finished: Path) -> None:
    text = (finished / "run.yaml").read_text().replace("cube.npy", str(finished / "cube.npy"))
    (folder / "run.yaml").write_text(text.replace("{with: {group_size: 50}}", "{with: {group_size: auto}}"))
    result = invoke("run", "run.yaml", "-v", "--log", "run.log")
    assert re.search(r"^group_size \d+: at ", result.stderr, re.MULTILINE)
    assert re.search(r"^took [\d.]+ m?s", result.stderr, re.MULTILINE)
    for stage in ("level 1: merge and locate", "panorama", "residuals", "halves"):
        assert re.search(rf"^{stage}: [\d,]+ \w+ in [\d.]+ m?s$", result.stderr, re.MULTILINE), stage
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
