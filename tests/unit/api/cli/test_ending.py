"""Commands end with a sentence and an exit code: on errors, on signals, and where nobody reads their output."""

import logging
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import typer

from photonpano import PluginError
from photonpano.api.cli.errors import Signalled, end_on_signals, reported

PROGRAM = """\
import os, signal, time
from pathlib import Path
from photonpano.files.folders import atomic_path
from photonpano.api.cli.app import app, main
from photonpano.api.cli.signatures import LoadedCommand as Command
from photonpano.files.folders import staging_of

@app.command(cls=Command)
def work():
    with atomic_path(Path("cube.npy")), staging_of(Path("run").absolute(), "run") as folder:
        (folder / "run.json").write_text("{}")
        print("working", flush=True)
        WORK

main()
"""


def heed_signals() -> None:
    """Restore signals that shells disable in their background jobs."""
    for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(each, signal.SIG_DFL)


@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_command_and_leaves_no_file(tmp_path: Path, sent: signal.Signals) -> None:
    command = [sys.executable, "-c", PROGRAM.replace("WORK", "time.sleep(60)"), "work"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=tmp_path, preexec_fn=heed_signals, **pipes) as process:
        assert process.stdout.readline() == "working\n"
        process.send_signal(sent)
        out, err = process.communicate(timeout=10)
    assert (process.returncode, out) == (128 + sent, "")
    assert err == "\ninterrupted; no file is left half-written under its final name\n"
    assert list(tmp_path.iterdir()) == []


def test_signal_in_a_callback_of_llvm_is_raised_after_it() -> None:
    """LLVM, which loads compiled code, calls Python, and what is raised there is lost."""
    before = {each: signal.signal(each, signal.SIG_DFL) for each in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    module = {"__name__": "llvmlite.binding.executionengine", "raise_signal": signal.raise_signal}
    try:
        end_on_signals()
        eval("raise_signal(2)", module)
        with pytest.raises(Signalled) as raised:
            time.sleep(10)
        assert raised.value.args == (signal.SIGINT,)
        with pytest.raises(Signalled):
            signal.raise_signal(signal.SIGINT)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_full_standard_output_is_one_sentence(folder: Path, program: list[str]) -> None:
    """A limit on file sizes refuses the first byte, as a full disk does."""
    with (folder / "output").open("w") as output:
        done = subprocess.run(
            [*program, "plugins", "list"],
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


@pytest.mark.parametrize("debug", [False, True])
def test_sys_exit_in_the_middle_of_a_command_is_an_error(capsys: pytest.CaptureFixture[str], debug: bool) -> None:
    with pytest.raises(typer.Exit) as ended, reported(debug=debug):
        sys.exit(0)
    printed = capsys.readouterr().err
    assert ended.value.exit_code == 1
    assert "error: a plugin or a library called sys.exit(0) in the middle of the command\n" in printed
    assert ("Traceback" in printed) == debug
    assert printed.endswith("for the traceback: photonpano --debug ...\n") == (not debug)


def test_closed_pipe_is_no_error(folder: Path, program: list[str]) -> None:
    with subprocess.Popen([*program, "schema"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
