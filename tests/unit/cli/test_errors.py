"""Error messages and exit codes of commands."""

from __future__ import annotations

import logging
import signal
import subprocess
import time
from pathlib import Path

import pytest
import typer

from photonpano import PluginError
from photonpano.cli.errors import reported


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


SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP


def heed_signals() -> None:
    """Restore what shells disable in their background jobs, and `nohup` in all."""
    for each in SIGNALS:
        signal.signal(each, signal.SIG_DFL)


@pytest.mark.parametrize("sent", SIGNALS)
def test_interrupted_command_leaves_no_file(folder: Path, program: list[str], sent: signal.Signals) -> None:
    command = [*program, "simulate", "capture.yaml", "--output", "cube.npy", "--set", "source.with.n_frames=100000"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, cwd=folder, text=True, preexec_fn=heed_signals, **pipes) as process:
        while not list(folder.glob(".cube*")) and process.poll() is None:
            time.sleep(0.02)
        process.send_signal(sent)
        out, err = process.communicate(timeout=60)
    assert (process.returncode, out) == (128 + sent, "")
    assert err == "\ninterrupted; no file is left half-written under its final name\n"
    assert [path.name for path in folder.iterdir()] == ["capture.yaml"]


def test_closed_pipe_is_no_error(folder: Path, program: list[str]) -> None:
    with subprocess.Popen([*program, "schema"], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""
