"""Commands end in time and with a sentence: on errors, signals, whatever plugins do, and when their work is done."""

import logging
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import typer

from photonpano import PluginError
from photonpano.api.cli.errors import reported

ENDS_WITHIN_S = 2.0
PROGRAM = """\
import ctypes, hashlib, itertools, threading, time
from pathlib import Path
from photonpano.files.atomic import atomic_path
from photonpano.api.cli.app import app, main
from photonpano.api.cli.signatures import LoadedCommand as Command
from photonpano.files.folders import staging_of
from photonpano.execution.threads import thread_pool

def swallow():
    while True:
        try:
            time.sleep(60)
        except KeyboardInterrupt:
            pass

@app.command(cls=Command)
def work():
    with atomic_path(Path("cube.npy")), staging_of(Path("run").absolute()) as folder:
        (folder / "run.json").write_text("{}")
        print("working", flush=True)
        WORK

main()
"""
IN_WORKER = "with thread_pool(2) as pool: pool.submit(time.sleep, 60); time.sleep(60)"
IN_THREAD = "threading.Thread(target=time.sleep, args=(60,)).start(); time.sleep(60)"
IN_C = "hashlib.pbkdf2_hmac('sha256', b'', b'', 2**30)"
HOLDING_INTERPRETER = "sum(itertools.repeat(0))"


@pytest.fixture
def working(tmp_path: Path) -> Callable[[str], subprocess.Popen[str]]:
    """Start a program whose only command does something in the middle of writing files, and wait until it does."""

    def start(work: str) -> subprocess.Popen[str]:
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM.replace("WORK", work), "work"], cwd=tmp_path, preexec_fn=heed_signals, **pipes
        )
        assert process.stdout.readline() == "working\n"
        time.sleep(0.05)
        return process

    return start


def heed_signals() -> None:
    """Restore signals that shells disable in their background jobs."""
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, signal.SIG_DFL)


def code_in_shell(process: subprocess.Popen[str]) -> int:
    """Return the exit code as shells show it, also if the signal itself has ended the process."""
    return process.returncode if process.returncode >= 0 else 128 - process.returncode


@pytest.mark.parametrize(
    ("work", "sent"),
    [
        (IN_WORKER, signal.SIGINT),
        (IN_THREAD, signal.SIGINT),
        (IN_C, signal.SIGHUP),
        ("swallow()", signal.SIGTERM),
        (HOLDING_INTERPRETER, signal.SIGINT),
    ],
    ids=["worker", "thread", "C", "swallowed", "holds the interpreter"],
)
def test_signal_ends_command_in_time_and_leaves_no_file(
    tmp_path: Path, working: Callable[[str], subprocess.Popen[str]], work: str, sent: signal.Signals
) -> None:
    with working(work) as process:
        start = time.monotonic()
        process.send_signal(sent)
        out, err = process.communicate(timeout=10)
        took = time.monotonic() - start
    assert code_in_shell(process) == 128 + sent
    assert out == ""
    assert took < ENDS_WITHIN_S
    if work != HOLDING_INTERPRETER:
        assert process.returncode == 128 + sent
        assert "\ninterrupted" in err
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("work", ["swallow()", HOLDING_INTERPRETER], ids=["swallowed", "holds the interpreter"])
def test_second_signal_ends_command_at_once(working: Callable[[str], subprocess.Popen[str]], work: str) -> None:
    with working(work) as process:
        process.send_signal(signal.SIGINT)
        time.sleep(0.2)
        start = time.monotonic()
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=10)
        took = time.monotonic() - start
    assert code_in_shell(process) == 130
    assert took < 0.7


def test_thread_left_by_plugin_keeps_no_process_alive(working: Callable[[str], subprocess.Popen[str]]) -> None:
    with working("threading.Thread(target=time.sleep, args=(60,)).start(); print('done')") as process:
        out = process.stdout.read()
        code = process.wait(timeout=20)
    assert (code, out) == (0, "done\n")


def test_program_ends_though_a_thread_never_started(program: list[str]) -> None:
    """A signal may come between the listing of a thread and its first step: such a thread cannot be joined."""
    code = """
import threading
from photonpano.api.cli.ending import leave
threading._limbo["stopped"] = threading.Thread()
leave(130)
"""
    done = subprocess.run([program[0], "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "")


def test_killed_command_leaves_no_process(working: Callable[[str], subprocess.Popen[str]]) -> None:
    with working("time.sleep(60)") as process:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children")
        if not children.exists():
            pytest.skip("only Linux lists the children of a process")
        guard = int(children.read_text())
        process.kill()
        process.communicate(timeout=10)
    for _ in range(100):
        if not is_alive(guard):
            return
        time.sleep(0.02)
    pytest.fail("the guard goes on")


def is_alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False
    return re.search(r"\) (\w)", state)[1] != "Z"


def test_ignored_signal_stays_ignored(tmp_path: Path) -> None:
    work = "import os, signal; os.kill(os.getpid(), signal.SIGHUP); time.sleep(0.05)"
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM.replace("WORK", work), "work"],
        cwd=tmp_path,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN),
        check=False,
    )
    assert done.returncode == 0


@pytest.mark.parametrize("arguments", [["--version"], ["plugins", "list"]], ids=" ".join)
def test_full_standard_output_is_one_sentence(folder: Path, program: list[str], arguments: list[str]) -> None:
    """A limit on file sizes refuses the first byte, as a full disk does."""
    with (folder / "output").open("w") as output:
        done = subprocess.run(
            [*program, *arguments],
            stdout=output,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0)),
            check=False,
        )
    assert (done.returncode, done.stderr) == (1, "error: cannot write to standard output: File too large\n")


def test_closed_streams_are_no_error_and_files_do_not_take_their_place(folder: Path, program: list[str]) -> None:
    command = '"$@" schema --output schema.json <&- >&- 2>&-'
    done = subprocess.run(["sh", "-c", command, "sh", *program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (folder / "schema.json").read_text().startswith("{")


@pytest.mark.parametrize("debug", [False, True])
def test_plugin_error_names_debug_option_if_it_has_a_cause(capsys: pytest.CaptureFixture[str], debug: bool) -> None:
    for cause in (ValueError("out of luck"), None):
        with pytest.raises(typer.Exit), reported(debug=debug):
            raise PluginError("locator 'toy' failed") from cause
        printed = capsys.readouterr().err
        assert ("Traceback" in printed) == debug
        assert "error: locator 'toy' failed\n" in printed
        assert printed.endswith("for the traceback: photonpano --debug ...\n") == (not debug and cause is not None)


@pytest.mark.parametrize("debug", [False, True])
def test_logged_warnings_are_printed(capsys: pytest.CaptureFixture[str], debug: bool) -> None:
    logger = logging.getLogger("photonpano.anywhere")
    with reported(debug=debug):
        logger.info("not this")
        try:
            _ = 1 / 0
        except ZeroDivisionError:
            logger.warning("%s came loose", "the cable", exc_info=True)
    printed = capsys.readouterr().err
    assert printed.endswith("warning: the cable came loose\n")
    assert printed.startswith("Traceback" if debug else "warning: ")
    assert not logging.getLogger("photonpano").handlers


def test_defects_keep_their_traceback() -> None:
    with pytest.raises(ZeroDivisionError), reported():
        _ = 1 / 0


def test_interrupted_command_leaves_no_file(folder: Path, program: list[str]) -> None:
    """By SIGHUP; the tests of `convert` send the other signals."""
    command = [*program, "simulate", "capture.yaml", "--output", "cube.npy", "--set", "source.with.n_frames=100000"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=folder, text=True, preexec_fn=heed_signals, **pipes) as process:
        while not list(folder.glob(".cube*")) and process.poll() is None:
            time.sleep(0.02)
        process.send_signal(signal.SIGHUP)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (128 + signal.SIGHUP, "")
    assert err == "\ninterrupted; no file is left half-written under its final name\n"
    assert [path.name for path in folder.iterdir()] == ["capture.yaml"]


def test_closed_pipe_is_no_error(folder: Path, program: list[str]) -> None:
    with subprocess.Popen([*program, "schema"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
