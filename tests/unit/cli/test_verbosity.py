"""-v, -q, --log, and completion."""

from __future__ import annotations

import errno
import io
import logging
import os
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from photonpano.cli.verbosity import is_quiet, is_verbose
from photonpano.context import Quiet

SIMULATE = ("simulate", "capture.yaml", "--output", "cube.npy", "--set", "source.with.n_frames=40")


@pytest.fixture(autouse=True)
def nothing_stays() -> Any:
    """What a command says ends with it."""
    yield
    assert not is_quiet()
    assert not is_verbose()
    logger = logging.getLogger("photonpano")
    assert (logger.handlers, logger.level) == ([], logging.NOTSET)


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
    log = (folder / "run.log").read_text()
    assert all(line in log for line in result.stderr.splitlines() if not re.search(r" in [\d.]+ m?s$", line))


def test_quiet_keeps_results_warnings_and_errors(
    folder: Path, invoke: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    from photonpano.cli.progress import progress_for_stderr

    shown = []
    monkeypatch.setattr("photonpano.cli.progress._progress_for_stderr", lambda _: shown.append(is_quiet()) or Quiet())
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


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("photonpano check-", "check-run"),
        ("photonpano info --source packed-n", "packed-npy"),
        ("photonpano run --keep", "--keep-work"),
    ],
    ids=["command", "component", "option"],
)
def test_shell_completes(program: list[str], words: str, expected: str) -> None:
    asked = {"_PHOTONPANO_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    done = subprocess.run(program, env={**os.environ, **asked}, capture_output=True, text=True, check=False)
    assert done.stdout.split() == [expected]
