"""Named pipes, devices, unreadable and endless files: each command refuses them with one sentence, and never waits."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from photonpano import InputError, SourceContext, SpecError, discover, evaluate, parse_spec
from photonpano.api.cli.app import app
from photonpano.pipeline.run import RunResult
from photonpano.reading import read_arrays

PIPE = "is a named pipe, not a regular file; copy what it holds to a file, and name that"
SOURCE = "version: 1\nsource: {use: packed-npy, with: {path: cube.npy}}\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a capture, a spec, and a named pipe that nobody writes to."""
    monkeypatch.chdir(tmp_path)
    np.save(tmp_path / "cube.npy", np.random.default_rng(0).integers(0, 256, (200, 16, 2), dtype=np.uint8))
    (tmp_path / "scan.yaml").write_text(SOURCE)
    for name in ("pipe.npy", "pipe.yaml"):
        os.mkfifo(tmp_path / name)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["info", "pipe.npy"], f"error: DIR/pipe.npy {PIPE}\n"),
        (["check", "pipe.yaml"], f"pipe.yaml: {PIPE}\nerror: the spec has 1 problem\n"),
        (["run", "pipe.yaml"], f"pipe.yaml: {PIPE}\nerror: the spec has 1 problem\n"),
        (
            ["check", "scan.yaml", "--set", "corrections=[{mask: {file: pipe.npy}}]"],
            f"corrections.0.mask.file: DIR/pipe.npy {PIPE} (in the override corrections=[{{mask: {{file: pipe.npy}}}}])\n"
            "error: the spec has 1 problem\n",
        ),
        (
            ["check", "scan.yaml", "--set", "source.with.path=/dev/zero"],
            "source.with.path: /dev/zero is a device, not a regular file; copy what it holds to a file, and name that "
            "(in the override source.with.path=/dev/zero)\nerror: the spec has 1 problem\n",
        ),
        (
            ["check", "scan.yaml", "--set", "source.with.path='~nosuchuser/cube.npy'"],
            "source.with.path: ~nosuchuser/cube.npy begins with the home folder of an unknown user; write the whole path "
            "(in the override source.with.path='~nosuchuser/cube.npy')\nerror: the spec has 1 problem\n",
        ),
        (
            ["check", "scan.yaml", "--set", 'source={use: auto, with: {path: "a\\0b.npy"}}'],
            "source.with.path: 'DIR/a\\x00b.npy' contains the character NUL, which no path can; correct the path "
            '(in the override source={use: auto, with: {path: "a\\0b.npy"}})\nerror: the spec has 1 problem\n',
        ),
    ],
    ids=["capture", "spec of check", "spec of run", "mask", "device", "home", "NUL"],
)
def test_special_path_is_refused_before_it_is_opened(folder: Path, arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 2
    assert result.stderr == message.replace("DIR", str(folder))


def test_pipe_as_truth_or_in_run_folder_is_refused(folder: Path, small_run: RunResult) -> None:
    with pytest.raises(InputError) as caught:
        read_arrays(folder / "pipe.npy", "a truth")
    assert str(caught.value) == f"{folder}/pipe.npy {PIPE}"
    with pytest.raises(InputError, match=r"pipe.npy is a named pipe"):
        evaluate(small_run.directory, folder / "pipe.npy", oracle=False)


def test_pipe_in_folder_of_pictures_is_refused(folder: Path) -> None:
    (folder / "pictures").mkdir()
    os.mkfifo(folder / "pictures" / "1.png")
    contribution = discover().find("source", "image-folder").contribution
    with pytest.raises(InputError) as caught:
        contribution.build(contribution.config(path=folder / "pictures"), SourceContext())
    assert str(caught.value) == f"{folder}/pictures/1.png {PIPE}"


def test_path_that_is_too_long_is_one_sentence(folder: Path) -> None:
    path = folder / f"{'x' * 300}.npy"
    with pytest.raises(SpecError) as caught:
        parse_spec({"version": 1, "source": {"use": "packed-npy", "with": {"path": path}}})
    assert str(caught.value) == f"source.with.path: cannot read {path}: File name too long"


def test_deeply_nested_record_is_one_sentence(folder: Path, small_run: RunResult) -> None:
    run = folder / "run"
    shutil.copytree(small_run.directory, run)
    (run / "run.json").write_text('{"spec": ' + "[" * 100_000 + "]" * 100_000 + "}")
    with pytest.raises(InputError, match=r"cannot be read as the record of a run"):
        evaluate(run, folder / "truth.npz")
