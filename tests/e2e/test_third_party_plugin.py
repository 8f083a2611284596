"""Build a third-party plugin, and install it beside an installed photonpano."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
from dataclasses import dataclass
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from typer.testing import CliRunner

from photonpano.api.cli.app import app

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "third_party_plugin"
# Commands of one process, each with its exit code after what it prints.
COMMANDS = """
import sys
import photonpano_example
from photonpano.api.cli import main
print(photonpano_example.__file__)
for arguments in {commands!r}:
    sys.argv[1:] = arguments
    try:
        main()
    except SystemExit as ended:
        print("exit code", ended.code or 0, flush=True)
"""


def done(*command: str | Path, folder: Path = ROOT) -> CompletedProcess[str]:
    """Run a command that has to succeed."""
    process = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stdout + process.stderr
    return process


@dataclass(frozen=True)
class Environment:
    """A virtual environment, its site-packages, and a folder to work in."""

    python: Path
    site: Path
    folder: Path


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """A new virtual environment with the packages of the current one and the plugin.

    It is built from a copy, to leave no files behind, with the installed hatchling, to download nothing.
    """
    folder = tmp_path_factory.mktemp("stranger")
    source = shutil.copytree(EXAMPLE, folder / "source", ignore=shutil.ignore_patterns("__pycache__"))
    home = folder / "venv"
    venv.create(home, symlinks=True)
    scripts, site = (
        Path(sysconfig.get_path(name, "venv", {"base": str(home), "platbase": str(home)})) for name in ("scripts", "purelib")
    )
    seen = {sysconfig.get_path(name) for name in ("purelib", "platlib")}
    # A folder that is only listed would be searched without its own .pth files, by which editable installs are found.
    (site / "base.pth").write_text("".join(f"import site; site.addsitedir({path!r})\n" for path in sorted(seen)))
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", scripts / "python"]
    done(*pip, "install", "--no-index", "--no-build-isolation", "--no-deps", source)
    for name in ("tests", "scan.yaml"):  # and not the package, which has to come from the environment
        path = EXAMPLE / name
        (shutil.copytree if path.is_dir() else shutil.copy)(path, folder / name)
    return Environment(scripts / "python", site, folder)


@pytest.fixture(scope="module")
def commands(environment: Environment, small_capture: Path) -> CompletedProcess[str]:
    """List the plugins, check a spec with a misspelt name, and run the spec of the example."""
    changes = {"source.with.path": small_capture, "resample.with.group_size": 50, "levels": 2, "refine": "[]"}
    options = [word for key, value in changes.items() for word in ("--set", f"{key}={value}")]
    arguments = [
        ["plugins", "list"],
        ["check", "scan.yaml", "--set", "locate.use=profile-shfit"],
        ["run", "scan.yaml", *options],
    ]
    return done(environment.python, "-c", COMMANDS.format(commands=arguments), folder=environment.folder)


def test_only_the_package_is_installed_and_is_imported_from_there(
    environment: Environment, commands: CompletedProcess[str]
) -> None:
    record = (environment.site / "photonpano_example-0.1.0.dist-info" / "RECORD").read_text()
    names = {line.partition(",")[0].partition("/")[0] for line in record.splitlines()}
    assert names == {"photonpano_example", "photonpano_example-0.1.0.dist-info"}
    assert Path(commands.stdout.splitlines()[0]).is_relative_to(environment.folder / "venv")


def test_plugins_list_shows_distribution_and_version(commands: CompletedProcess[str]) -> None:
    rows = [line.split()[:4] for line in commands.stdout.splitlines() if " photonpano-example " in line]
    assert rows == [
        ["merger", "short-exposure", "photonpano-example", "0.1.0"],
        ["locator", "profile-shift", "photonpano-example", "0.1.0"],
    ]


def test_misspelt_name_suggests_component_of_plugin(commands: CompletedProcess[str]) -> None:
    assert "exit code 2" in commands.stdout
    assert "locate.use: there is no locator 'profile-shfit'; did you mean 'profile-shift'?" in commands.stderr


def test_pipeline_runs_with_installed_plugin(environment: Environment, commands: CompletedProcess[str]) -> None:
    assert "exit code 1" not in commands.stdout
    record = json.loads((environment.folder / "runs" / "example" / "run.json").read_text())
    first, second = (level["located"] for level in record["levels"])
    assert first == 6
    assert second >= 12  # of 13
    theirs = [row for row in record["plugins"] if row["plugin"] == "photonpano-example"]
    assert theirs == [
        {"stage": "merge", "use": "short-exposure", "plugin": "photonpano-example", "version": "0.1.0"},
        {"stage": "locate", "use": "profile-shift", "plugin": "photonpano-example", "version": "0.1.0"},
    ]


def test_example_plugin_passes_its_own_tests(environment: Environment) -> None:
    own = ["-m", "pytest", "-q", "-W", "error", "-p", "no:cacheprovider", "tests"]
    printed = done(environment.python, *own, folder=environment.folder).stdout
    assert " passed" in printed
    assert "failed" not in printed


def test_names_of_missing_plugin_are_errors_with_suggestions(small_capture: Path, tmp_path: Path) -> None:
    shutil.copy(EXAMPLE / "scan.yaml", tmp_path)
    checked = CliRunner().invoke(app, ["check", str(tmp_path / "scan.yaml"), "--set", f"source.with.path={small_capture}"])
    assert checked.exit_code == 2
    merger, locator, last = checked.output.splitlines()
    known = "burst, local-flow, photon-mle and splat"
    assert merger.endswith(f"scan.yaml:9:8: merge.use: there is no merger 'short-exposure'; known: {known}")
    assert "scan.yaml:12:8: locate.use: there is no locator 'profile-shift'; known: chain-of-backends, direct, " in locator
    assert last == "error: the spec has 2 problems"


def test_source_distribution_excludes_example_plugin(tmp_path: Path) -> None:
    done(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", tmp_path)
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as tar:
        inside = {Path(name).parts[1] for name in tar.getnames()}
    ours = {"framework", "plugins", "README.md", "LICENSE", "constraints.txt", "pyproject.toml"}
    assert inside == ours | {".gitignore", "PKG-INFO"}
