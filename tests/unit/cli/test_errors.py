"""Error messages and exit codes of commands."""

from __future__ import annotations

import logging
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from photonpano import PluginError
from photonpano.cli.errors import reported

SOURCE = "version: 1\nsource: {use: packed-npy, with: {path: cube.npy}}\n"


def spec(folder: Path, text: str) -> str:
    (folder / "spec.yaml").write_text(text)
    return "spec.yaml"


@pytest.mark.parametrize("command", ["check", "run", "explain"])
def test_spec_problems_are_printed_one_per_line(folder: Path, invoke: Callable[..., Any], command: str) -> None:
    text = "version: 1\nsource: {use: packed-npy, with: {path: cube.npy}}\nresample: {group_size: 50}\nrender: {scale: big}\n"
    result = invoke(command, spec(folder, text), "--set", "run.seed=-1")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == (
        f"spec.yaml:2:1: source: there is no file {folder}/cube.npy; check the path\n"
        "spec.yaml:3:12: resample.group_size: unknown key; it belongs under `with`\n"
        "spec.yaml:4:17: render.scale: expected a number from 0.05 to 16, got 'big'\n"
        "run.seed: expected an integer of at least 0, got -1 (in the override run.seed=-1)\n"
        "error: the spec has 4 problems\n"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            SOURCE + "locate: {use: opencv-shift}\n",
            "spec.yaml:3:15: locate.use: there is no locator 'opencv-shift'; "
            "did you mean 'opencv-sift', 'opencv-orb' or 'opencv-ecc'?\n",
        ),
        (SOURCE + "level: 3\n", "spec.yaml:3:1: level: unknown key; did you mean 'levels'?\n"),
    ],
    ids=["component", "key"],
)
def test_single_spec_problem_is_printed_with_suggestion(
    folder: Path, invoke: Callable[..., Any], text: str, message: str
) -> None:
    np.save(folder / "cube.npy", np.zeros((2, 4, 1), np.uint8))
    result = invoke("check", spec(folder, text))
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == message + "error: the spec has 1 problem\n"


def test_run_reports_missing_spec(folder: Path, invoke: Callable[..., Any]) -> None:
    result = invoke("run", folder / "nowhere.yaml")
    assert (result.exit_code, result.stderr) == (
        2,
        f"{folder}/nowhere.yaml: there is no such file\nerror: the spec has 1 problem\n",
    )


@pytest.mark.parametrize("command", ["check", "run", "explain"])
def test_capture_shorter_than_group_is_spec_problem(folder: Path, invoke: Callable[..., Any], command: str) -> None:
    np.save(folder / "cube.npy", np.zeros((20, 4, 1), np.uint8))
    result = invoke(command, spec(folder, SOURCE + "resample: {use: midpoint, with: {group_size: 30}}\n"))
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == (
        "spec.yaml:3:1: resample: the capture has 20 frames, fewer than one group of 30; "
        "set group_size to 5 or less, so that at least four groups fit\nerror: the spec has 1 problem\n"
    )
    assert not (folder / "runs").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["simulate", "capture.yaml", "--output", "cube.bin"],
            "error: cannot write cube.bin: a packed capture is a .npy file; name it cube.bin.npy\n",
        ),
        (
            ["simulate", "capture.yaml", "--output", "no/cube.npy"],
            "error: cannot write no/cube.npy: there is no folder no; create it or choose another\n",
        ),
        (
            ["schema", "--output", "no/schema.json"],
            "error: cannot write no/schema.json: there is no folder no; create it or choose another\n",
        ),
        (
            ["run", "capture.yaml", "--output", "capture.yaml/run"],
            "error: {folder}/capture.yaml/run: the run folder cannot be written to (Not a directory); "
            "choose another one with --output\n",
        ),
        (
            ["evaluate", "nowhere", "--truth", "truth.npz", "--no-oracle"],
            "error: nowhere is not a folder; give the run folder that `photonpano run` wrote\n",
        ),
    ],
    ids=["suffix", "folder", "schema", "run folder", "evaluate"],
)
def test_failed_command_exits_1_and_writes_nothing(
    folder: Path, invoke: Callable[..., Any], arguments: list[str], message: str
) -> None:
    result = invoke(*arguments)
    assert (result.exit_code, result.stdout) == (1, "")
    assert result.stderr == message.replace("{folder}", str(folder))
    assert [path.name for path in folder.iterdir()] == ["capture.yaml"]


def test_square_brackets_in_messages_are_not_markup(folder: Path, invoke: Callable[..., Any]) -> None:
    result = invoke("check", folder / "[bold]no[bold].yaml")
    assert "[bold]no[bold].yaml: there is no such file" in result.stderr


@pytest.mark.parametrize(("options", "environment"), [(["--debug"], {}), ([], {"PHOTONPANO_DEBUG": "1"})])
def test_debug_option_shows_traceback(
    folder: Path, invoke: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, options: list[str], environment: dict[str, str]
) -> None:
    assert "Traceback" not in invoke("run", "nowhere.yaml").stderr
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    result = invoke(*options, "run", "nowhere.yaml")
    assert result.exit_code == 2
    assert result.stderr.startswith("Traceback (most recent call last):")
    assert result.stderr.endswith("error: the spec has 1 problem\n")


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


def test_unknown_name_of_disabled_plugin_is_warned_of(
    folder: Path, invoke: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PHOTONPANO_DISABLE_PLUGINS", "opencw")
    result = invoke("check", "capture.yaml")
    assert result.exit_code == 0
    assert result.stderr == (
        "warning: PHOTONPANO_DISABLE_PLUGINS names 'opencw', which is no installed plugin; did you mean 'opencv'?\n"
    )


def test_component_of_disabled_plugin_names_what_disables_it(
    folder: Path, invoke: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PHOTONPANO_DISABLE_PLUGINS", "opencv")
    result = invoke("check", "capture.yaml", "--set", "locate.use=opencv-sift")
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == (
        "locate.use: there is no locator 'opencv-sift'; known: chain-of-backends, direct, kornia-features, kornia-loftr, "
        "kornia-registrator and pycolmap-two-view. Disabled plugins may have offered it: photonpano 0.1.0 "
        "(opencv = photonpano_opencv.hooks), by PHOTONPANO_DISABLE_PLUGINS=opencv (in the override locate.use=opencv-sift)\n"
        "error: the spec has 1 problem\n"
    )


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
