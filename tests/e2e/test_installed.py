"""Build what is published, and a third-party plugin, and install them as users do."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
import zipfile
from dataclasses import dataclass
from email import message_from_bytes
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from typer.testing import CliRunner

from photonpano.api.cli.app import app

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
FOLDERS = ROOT / "framework", ROOT / "plugins"
EXAMPLE = ROOT / "examples" / "third_party_plugin"
PROGRAM = """
import sys
import photonpano_example
from photonpano.api.cli import main
print(photonpano_example.__file__)
sys.argv[1:] = {arguments!r}
main()
"""


def done(*command: str | Path, folder: Path = ROOT) -> CompletedProcess[str]:
    """Run a command that has to succeed, with what is installed alone."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    process = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stdout + process.stderr
    return process


@dataclass(frozen=True)
class Environment:
    """A virtual environment, its site-packages, and a folder to work in."""

    python: Path
    site: Path
    folder: Path


def environment_with(package: Path, folder: Path, line: str) -> Environment:
    """Install a package into a new virtual environment in a folder.

    It has the packages of the current one too, each folder of which is a line of a .pth file. Nothing is downloaded.
    """
    home = folder / "venv"
    venv.create(home, symlinks=True)
    scripts, site = (
        Path(sysconfig.get_path(name, "venv", {"base": str(home), "platbase": str(home)})) for name in ("scripts", "purelib")
    )
    seen = {sysconfig.get_path(name) for name in ("purelib", "platlib")}
    (site / "base.pth").write_text("".join(line.format(path) for path in sorted(seen)))
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", scripts / "python"]
    done(*pip, "install", "--no-index", "--no-build-isolation", "--no-deps", "--no-compile", package)
    return Environment(scripts / "python", site, folder)


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """The plugin beside the photonpano of the tests. It is built from a copy, to leave no files behind."""
    folder = tmp_path_factory.mktemp("stranger")
    source = shutil.copytree(EXAMPLE, folder / "source", ignore=shutil.ignore_patterns("__pycache__"))
    # A folder that is only listed would be searched without its own .pth files, by which editable installs are found.
    made = environment_with(source, folder, "import site; site.addsitedir({!r})\n")
    shutil.copy(EXAMPLE / "scan.yaml", folder)  # and not the package, which has to come from the environment
    return made


@pytest.fixture(scope="module")
def commands(environment: Environment, small_capture: Path) -> CompletedProcess[str]:
    """Run the spec of the example."""
    changes = {"source.with.path": small_capture, "resample.with.group_size": 50, "levels": 2, "refine": "[]"}
    options = [word for key, value in changes.items() for word in ("--set", f"{key}={value}")]
    program = PROGRAM.format(arguments=["run", "scan.yaml", *options])
    return done(environment.python, "-c", program, folder=environment.folder)


def test_only_the_package_is_installed_and_is_imported_from_there(
    environment: Environment, commands: CompletedProcess[str]
) -> None:
    record = (environment.site / "photonpano_example-0.1.0.dist-info" / "RECORD").read_text()
    names = {line.partition(",")[0].partition("/")[0] for line in record.splitlines()}
    assert names == {"photonpano_example", "photonpano_example-0.1.0.dist-info"}
    assert Path(commands.stdout.splitlines()[0]).is_relative_to(environment.folder / "venv")


def test_pipeline_runs_with_installed_plugin(environment: Environment, commands: CompletedProcess[str]) -> None:
    record = json.loads((environment.folder / "runs" / "example" / "run.json").read_text())
    first, second = (level["located"] for level in record["levels"])
    assert first == 6
    assert second >= 12  # of 13
    theirs = [row for row in record["plugins"] if row["plugin"] == "photonpano-example"]
    assert theirs == [
        {"stage": "merge", "use": "short-exposure", "plugin": "photonpano-example", "version": "0.1.0"},
        {"stage": "locate", "use": "profile-shift", "plugin": "photonpano-example", "version": "0.1.0"},
    ]


def test_names_of_missing_plugin_are_errors_with_suggestions(small_capture: Path, tmp_path: Path) -> None:
    shutil.copy(EXAMPLE / "scan.yaml", tmp_path)
    checked = CliRunner().invoke(app, ["check", str(tmp_path / "scan.yaml"), "--set", f"source.with.path={small_capture}"])
    assert checked.exit_code == 2
    merger, locator, last = checked.output.splitlines()
    known = "local-flow, photon-mle and splat"
    assert merger.endswith(f"scan.yaml:9:8: merge.use: there is no merger 'short-exposure'; known: {known}")
    assert "scan.yaml:12:8: locate.use: there is no locator 'profile-shift'; known: direct, " in locator
    assert last == "error: the spec has 2 problems"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the source distribution, and of the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    done(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder)
    return folder


def test_source_distribution_excludes_example_plugin(built: Path) -> None:
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as tar:
        inside = {Path(name).parts[1] for name in tar.getnames()}
    files = {"README.md", "CHANGELOG.md", "CITATION.cff", "LICENSE", "constraints.txt", "pyproject.toml"}
    assert inside == files | {"framework", "plugins", ".gitignore", "PKG-INFO"}


def test_wheel_holds_every_file_of_the_packages(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    inside = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    there = {file.relative_to(folder).as_posix() for folder in FOLDERS for file in folder.rglob("*.*") if file.is_file()}
    assert inside == {name for name in there if "__pycache__" not in name}
    assert {name for name in inside if name.count("/") == 1 and name.endswith("/py.typed")} == {
        f"{name.partition('/')[0]}/py.typed" for name in inside
    }


def test_package_index_shows_description_whose_links_lead_to_files_of_the_version(built: Path) -> None:
    done(sys.executable, "-m", "twine", "check", "--strict", *built.iterdir())
    (wheel,) = built.glob("*.whl")
    archive = zipfile.ZipFile(wheel)
    (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
    description = message_from_bytes(archive.read(name)).get_payload()
    home, tag = PROJECT["urls"]["Homepage"], f"v{PROJECT['version']}"
    pages, pictures = f"{home}/blob/{tag}/", f"{home.replace('github.com', 'raw.githubusercontent.com')}/{tag}/"
    images = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", description)
    links = re.findall(r"\]\(([^)]+)\)", description)
    assert images
    assert [link for link in images if not link.startswith(pictures)] == []
    targets = [link.removeprefix(pictures).removeprefix(pages).partition("#")[0] for link in links]
    assert [target for target in targets if not (ROOT / target).is_file()] == []


def test_installed_wheel_offers_its_plugins(built: Path, tmp_path: Path) -> None:
    """`.github/workflows/wheel.yml` runs the demo from it."""
    (wheel,) = built.glob("*.whl")
    installed = environment_with(wheel, tmp_path, "{}\n")  # the checkout is not there
    where = "import photonpano, photonpano_core as core; print(photonpano.__file__, core.__file__, photonpano.__version__)"
    *files, version = done(installed.python, "-c", where, folder=tmp_path).stdout.split()
    assert all(Path(file).is_relative_to(installed.site) for file in files)
    assert version == PROJECT["version"]
    listed = done(installed.python.with_name("photonpano"), "plugins", "list", folder=tmp_path).stdout
    assert {"photon-mle", "simulator", "opencv-sift"} <= set(listed.split())
