import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from photonpano.api.cli.app import app

CAPTURE = """\
version: 1
source:
  use: simulator
  with:
    scene: {kind: street, width: 400, height: 300}
    path: {kind: pan, length_px: 20}
    flux: 1
    n_frames: 200
    frame_shape: [96, 160]
resample: {with: {group_size: 50}}
levels: 1
"""
RUN = """\
version: 1
source: {use: packed-npy, with: {path: cube.npy, frame_rate_hz: 96800}}
resample: {with: {group_size: 50}}
levels: 1
output: {directory: run}
"""
PROGRAM = [sys.executable, "-c", "from photonpano.api.cli import main; main()"]


@pytest.fixture
def invoke() -> Callable[..., Result]:
    """Run a command in this process."""
    return lambda *arguments: CliRunner().invoke(app, [str(each) for each in arguments], catch_exceptions=False)


@pytest.fixture
def program() -> list[str]:
    """The start of a command line that runs the program in a process of its own."""
    return PROGRAM


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with the spec of a small capture in `capture.yaml`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PHOTONPANO_DEBUG", raising=False)
    (tmp_path / "capture.yaml").write_text(CAPTURE)
    return tmp_path


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a simulated capture `cube.npy`, its run in `run`, and what both commands printed in `.out` and `.err`."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "capture.yaml").write_text(CAPTURE)
    (folder / "run.yaml").write_text(RUN)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for name, arguments in (("simulate", ["capture.yaml", "--output", "cube.npy"]), ("run", ["run.yaml"])):
            done = CliRunner().invoke(app, [name, *arguments], catch_exceptions=False)
            assert done.exit_code == 0, done.output
            (folder / f"{name}.out").write_text(done.stdout)
            (folder / f"{name}.err").write_text(done.stderr)
    return folder
