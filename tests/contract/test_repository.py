"""What several files of the repository say of the same thing agrees."""

from __future__ import annotations

import re
import subprocess
import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from ruamel.yaml import YAML

import photonpano
from photonpano.reading.files import LIBRARIES

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
TOOLS = PROJECT["tool"]
PLUGINS = {path.parent.name for path in ROOT.glob("plugins/*/__init__.py")}
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
CONTRACTS = {contract["name"]: contract for contract in TOOLS["importlinter"]["contracts"]}


def read_yaml(path: Path) -> dict[str, Any]:
    content: dict[str, Any] = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    return content


CITATION, RECIPE = read_yaml(ROOT / "CITATION.cff"), read_yaml(ROOT / "packaging" / "conda" / "recipe.yaml")


def pins() -> dict[str, str]:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {canonicalize_name(name): version for name, version in pairs}


def test_version_and_day_of_release_are_the_same_everywhere() -> None:
    version = PROJECT["project"]["version"]
    assert {photonpano.__version__, CITATION["version"], RECIPE["context"]["version"]} == {version}
    newest = re.search(r"^## (\S+) - (\S+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert newest is not None
    assert newest.groups() == (version, str(CITATION["date-released"]))
    short = version.rpartition(".")[0]
    assert f"This is version {short}. " in (ROOT / "README.md").read_text(encoding="utf-8")
    assert f"It is about photonpano {short}.\n" in (ROOT / "docs" / "reference" / "stability.md").read_text(encoding="utf-8")


def test_conda_recipe_needs_what_the_project_needs() -> None:
    names = {"matplotlib": "matplotlib-base", "opencv-python-headless": "py-opencv"}
    own = {"pip", "python", "__unix"}
    for kind, wanted in (("run", PROJECT["project"]["dependencies"]), ("host", PROJECT["build-system"]["requires"])):
        lines = [line for line in RECIPE["requirements"][kind] if line.split()[0] not in own]
        needs = map(Requirement, wanted)
        assert {str(Requirement(line)) for line in lines} == {f"{names.get(r.name, r.name)}{r.specifier}" for r in needs}
    assert PROJECT["project"]["requires-python"] == f">={RECIPE['context']['python_min']}"


def test_every_dependency_is_pinned_to_a_version_that_it_allows() -> None:
    project = PROJECT["project"]
    optional = [line for group in project["optional-dependencies"].values() for line in group]
    pinned = pins()
    for line in [*project["dependencies"], *optional, *PROJECT["build-system"]["requires"]]:
        requirement = Requirement(line)
        if requirement.name == project["name"]:  # an extra that consists of others
            assert requirement.extras <= set(project["optional-dependencies"])
            continue
        assert requirement.specifier.contains(pinned[canonicalize_name(requirement.name)]), line


def test_every_pinned_version_runs_on_the_oldest_python_that_is_supported() -> None:
    oldest = PROJECT["project"]["requires-python"].removeprefix(">=") + ".0"
    pinned = pins()
    refused = {
        package.name: needed
        for package in metadata.distributions()
        if canonicalize_name(package.name) in pinned
        and (needed := package.metadata.get("Requires-Python"))
        and not SpecifierSet(needed).contains(oldest)
    }
    assert not refused, "constraints.txt: pin versions that run on Python " + oldest


def test_every_extra_is_what_a_component_asks_for() -> None:
    """What is said of a missing library, `pip install "photonpano[kornia]"`, names an extra that there is, and none is idle."""
    rows = [entry for entry in photonpano.discover().rows if entry.origin.plugin == "photonpano"]
    asked = {requirement.install for entry in rows for requirement in entry.contribution.requires}
    asked |= {install for _, install in LIBRARIES.values() if install.startswith("photonpano[")}
    asked |= {"photonpano[xarray]", "photonpano[fits]"}  # for load_xarray alone, and for some of the lists of photons
    extras = {
        f"photonpano[{name}]" for name in PROJECT["project"]["optional-dependencies"] if name not in ("dev", "docs", "testing")
    }
    assert asked == extras


@pytest.mark.parametrize(
    "listed",
    [
        {path.removeprefix("plugins/") for path in TOOLS["hatch"]["build"]["targets"]["wheel"]["packages"]}
        - {"framework/photonpano"},
        set(TOOLS["mypy"]["packages"]) - {"photonpano", "photonpano_example"},
        set(TOOLS["importlinter"]["root_packages"]) - {"photonpano"},
        set(CONTRACTS["the framework never imports a plugin"]["forbidden_modules"]),
        set(re.findall(r"\w+", " ".join(CONTRACTS["plugins do not know each other"]["layers"]))),
        set(CONTRACTS["plugins import public names only"]["source_modules"]),
        {module.partition(".")[0] for module in PROJECT["project"]["entry-points"]["photonpano"].values()} - {"photonpano"},
    ],
    ids=["wheel", "mypy", "import-linter", "forbidden to the framework", "independent", "public names only", "entry points"],
)
def test_every_plugin_is_shipped_and_checked(listed: set[str]) -> None:
    assert listed == PLUGINS


def test_make_help_names_every_target() -> None:
    phony = re.search(r"^\.PHONY: (.*)$", MAKEFILE, re.MULTILINE)
    assert phony is not None
    named = set(re.findall(r"@echo 'make (\w+) ", MAKEFILE))
    assert named | {"help"} == set(phony[1].split())


def test_continuous_integration_can_be_started() -> None:
    script = ROOT / ".ci" / "run"
    assert script.stat().st_mode & 0o111
    subprocess.run(["bash", "-n", script], check=True)
    assert "make check" in script.read_text(encoding="utf-8")


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.name)
def test_workflow_names_targets_and_files_that_exist(path: Path) -> None:
    text, workflow = path.read_text(encoding="utf-8"), read_yaml(path)
    assert {"name", "on", "permissions", "jobs"} <= set(workflow)
    targets = re.findall(r"\bmake (\w+) PYTHON=python", text)
    assert [target for target in targets if not re.search(rf"^{target}:", MAKEFILE, re.MULTILINE)] == []
    files = re.findall(r"(?:uses: \./|cache-dependency-path: )([\w./]+)", text)
    assert [file for file in files if not (ROOT / file).is_file()] == []
    assert targets or files


def test_workflow_tests_every_python_that_the_classifiers_name() -> None:
    named = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["project"]["classifiers"]))
    matrix = read_yaml(ROOT / ".github" / "workflows" / "tests.yml")["jobs"]["tests"]["strategy"]["matrix"]
    assert matrix["python"] == named


def test_container_gets_what_the_wheel_is_built_from() -> None:
    lines = re.findall(r"^COPY (.+) \S+$", (ROOT / "Dockerfile").read_text(encoding="utf-8"), re.MULTILINE)
    copied = {name for line in lines for name in line.split()}
    packages = {path.partition("/")[0] for path in TOOLS["hatch"]["build"]["targets"]["wheel"]["packages"]}
    read = {fragment["path"] for fragment in TOOLS["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["fragments"]}
    assert copied == {"pyproject.toml", "constraints.txt", *packages, *read, *PROJECT["project"]["license-files"]}
