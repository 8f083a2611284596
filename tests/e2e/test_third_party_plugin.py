"""Build a third-party plugin, and install it beside an installed photonpano."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from dataclasses import dataclass
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from typer.testing import CliRunner

from photonpano.cli.app import app

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "third_party_plugin"
PIP = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
CLI = "from photonpano.cli import main; main()"


@dataclass(frozen=True)
class Environment:
    """A virtual environment and a folder to work in."""

    python: Path
    folder: Path

    def run(self, *arguments: str | Path) -> CompletedProcess[str]:
        """Run its Python."""
        command = [self.python, *arguments]
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=False)

    def photonpano(self, *arguments: str | Path) -> CompletedProcess[str]:
        """Run photonpano of this environment."""
        return self.run("-c", CLI, *arguments)


def done(process: CompletedProcess[str]) -> str:
    """Require that a process succeeded, and return its output."""
    assert process.returncode == 0, process.stdout + process.stderr
    return process.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build from a copy, to leave no files behind, with the installed hatchling, to download nothing."""
    folder = tmp_path_factory.mktemp("wheel")
    source = shutil.copytree(EXAMPLE, folder / "source", ignore=shutil.ignore_patterns("__pycache__"))
    build = [*PIP, "wheel", "--no-index", "--no-build-isolation", "--no-deps", "--wheel-dir", folder, source]
    done(subprocess.run(build, capture_output=True, text=True, check=False))
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """A new virtual environment with the packages of the current one and the wheel."""
    folder = tmp_path_factory.mktemp("stranger")
    home = folder / "venv"
    venv.create(home, symlinks=True)
    scripts, site = (
        Path(sysconfig.get_path(name, "venv", {"base": str(home), "platbase": str(home)})) for name in ("scripts", "purelib")
    )
    seen = {sysconfig.get_path(name) for name in ("purelib", "platlib")}
    # A folder that is only listed would be searched without its own .pth files, by which editable installs are found.
    (site / "base.pth").write_text("".join(f"import site; site.addsitedir({path!r})\n" for path in sorted(seen)))
    environment = Environment(scripts / "python", folder)
    done(subprocess.run([*PIP, "--python", environment.python, "install", "--no-index", wheel], capture_output=True, text=True))
    for name in ("tests", "scan.yaml"):  # and not the package, which has to come from the wheel
        path = EXAMPLE / name
        (shutil.copytree if path.is_dir() else shutil.copy)(path, folder / name)
    return environment


def test_wheel_contains_package_only(wheel: Path) -> None:
    names = {name.partition("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert names == {"photonpano_example", "photonpano_example-0.1.0.dist-info"}


def test_installed_plugin_is_imported_from_environment(environment: Environment) -> None:
    module = Path(done(environment.run("-c", "import photonpano_example; print(photonpano_example.__file__)")).strip())
    assert module.is_relative_to(environment.folder / "venv")


def test_plugins_list_shows_distribution_and_version(environment: Environment) -> None:
    listed = done(environment.photonpano("plugins", "list"))
    rows = [line.split()[:4] for line in listed.splitlines() if "photonpano-example" in line]
    assert rows == [
        ["merger", "short-exposure", "photonpano-example", "0.1.0"],
        ["locator", "profile-shift", "photonpano-example", "0.1.0"],
    ]


def test_example_plugin_passes_its_own_tests(environment: Environment) -> None:
    printed = done(environment.run("-m", "pytest", "-q", "-W", "error", "-p", "no:cacheprovider", "tests"))
    assert " passed" in printed
    assert "failed" not in printed


def test_pipeline_runs_with_installed_plugin(environment: Environment, small_capture: Path) -> None:
    changes = {"source.with.path": small_capture, "resample.with.group_size": 50, "levels": 2}
    options = [word for key, value in changes.items() for word in ("--set", f"{key}={value}")]
    done(environment.photonpano("run", "scan.yaml", *options))
    record = json.loads((environment.folder / "runs" / "example" / "run.json").read_text())
    first, second = (level["located"] for level in record["levels"])
    assert first == 6
    assert second >= 12  # of 13
    theirs = [row for row in record["plugins"] if row["plugin"] == "photonpano-example"]
    assert theirs == [
        {"stage": "merge", "use": "short-exposure", "plugin": "photonpano-example", "version": "0.1.0"},
        {"stage": "locate", "use": "profile-shift", "plugin": "photonpano-example", "version": "0.1.0"},
    ]


def test_misspelt_name_suggests_component_of_plugin(environment: Environment) -> None:
    checked = environment.photonpano("check", "scan.yaml", "--set", "locate.use=profile-shfit")
    assert checked.returncode == 2
    assert "locate.use: there is no locator 'profile-shfit'; did you mean 'profile-shift'?" in checked.stderr


def test_names_of_missing_plugin_are_errors_with_suggestions(small_capture: Path, tmp_path: Path) -> None:
    shutil.copy(EXAMPLE / "scan.yaml", tmp_path)
    checked = CliRunner().invoke(app, ["check", str(tmp_path / "scan.yaml"), "--set", f"source.with.path={small_capture}"])
    assert checked.exit_code == 2
    merger, locator, last = checked.output.splitlines()
    known = "burst, local-flow, photon-mle, robust-merge and splat"
    assert merger.endswith(f"scan.yaml:9:8: merge.use: there is no merger 'short-exposure'; known: {known}")
    assert "scan.yaml:12:8: locate.use: there is no locator 'profile-shift'; known: chain-of-backends, direct, " in locator
    assert last == "error: the spec has 2 problems"


def test_source_distribution_excludes_example_plugin(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", tmp_path]
    done(subprocess.run(build, cwd=ROOT, capture_output=True, text=True, check=False))
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as tar:
        inside = {Path(name).parts[1] for name in tar.getnames()}
    assert inside == {
        "framework",
        "plugins",
        "README.md",
        "LICENSE",
        "constraints.txt",
        "pyproject.toml",
        ".gitignore",
        "PKG-INFO",
    }
