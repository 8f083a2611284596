"""The demo: what is in its folder, its score, and its report in a browser."""

import re
import webbrowser
from pathlib import Path

import pytest
from typer.testing import CliRunner

import photonpano.api
from photonpano import load_spec
from photonpano.api.cli.app import app


def test_demo_is_scored_and_its_report_is_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr(webbrowser, "open", asked.append)  # false, as without a browser
    made = tmp_path / "made"
    done = CliRunner().invoke(app, ["demo", str(made), "--small", "--open"])
    assert done.exit_code == 0, done.output
    assert {file.name for file in made.iterdir()} == {"capture.yaml", "capture.npy", "capture.truth.npz", "scan.yaml", "run"}
    scores = dict(re.findall(r"^(.+?)  +(-?[\d.]+)(?: |$)", done.stdout, re.MULTILINE))
    assert "verdict   trusted\n" in done.stdout
    assert float(scores["frames located"]) == 100
    assert float(scores["corner error, worst frame"]) < 0.1
    assert float(scores["PSNR below the oracle"]) < 0.1
    report = made.resolve() / "run" / "report.html"
    assert asked == [report.as_uri()]
    assert done.stderr.endswith(f"warning: no browser could be started; open {report} in one\n")


def test_specs_of_large_demo_are_right(tmp_path: Path) -> None:
    (specs,) = Path(photonpano.api.__path__[0]).glob("demo_specs")
    assert load_spec(specs / "capture.yaml").source.config.n_frames == 4000
