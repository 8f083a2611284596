"""Compare the documentation with the code: what it lists is there, and what is there is listed."""

from __future__ import annotations

import importlib.util
import inspect
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import photonpano
from photonpano import discover
from photonpano.api.cli.app import commands
from photonpano.corrections import CORRECTIONS
from photonpano.plugins import hookspecs
from photonpano.residuals import causes, verdict
from photonpano_poses import run as pose_run

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "docs" / "reference"


def ident(page: Path) -> str:
    return str(page.relative_to(ROOT))


def test_architecture_page_names_every_package_and_module():
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    parts = [path for folder in ("framework/photonpano", "plugins") for path in (ROOT / folder).iterdir()]
    names = [path.stem for path in parts if (path / "__init__.py").exists() or path.suffix == ".py"]
    assert [name for name in sorted(names) if f"`{name}`" not in page and not name.startswith("__")] == []


def test_architecture_page_lists_import_layers_bottom_up():
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    shown = [set(re.findall(r"`(\w+)`", line)) for line in re.findall(r"^\d+\. .+$", page, re.MULTILINE)]
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    assert shown == [set(re.findall(r"photonpano\.(\w+)", layer)) for layer in reversed(layers)]


def test_promises_page_names_tests_that_exist():
    page = (ROOT / "docs" / "explanation" / "promises.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`(test_\w+)`", page))
    written = {
        name
        for file in (*(ROOT / "tests").rglob("test_*.py"), *(ROOT / "framework" / "photonpano" / "testing").glob("*.py"))
        for name in re.findall(r"def (test_\w+)", file.read_text(encoding="utf-8"))
    }
    assert len(named) > 20
    assert sorted(named - written) == []


def test_trust_page_shows_thresholds_of_verdict():
    page = (ROOT / "docs" / "explanation" / "trust.md").read_text(encoding="utf-8")
    shown = re.findall(r"^\|[^|]+\|[^|]+\| ([\d.]+) \|$", page, re.MULTILINE)
    assert shown == [f"{test.threshold:g}" for test in (*verdict.FACTS, *verdict.AGREEMENT, *causes.CAUSES)]
    assert f"more than {100 * verdict.MAX_CONTRAST:g} % of the light" in page


def test_poses_page_shows_thresholds_of_verdict():
    page = (ROOT / "docs" / "how-to" / "poses.md").read_text(encoding="utf-8")
    _, _, table = page.partition("## The verdict")
    shown = re.findall(r"^\|[^|]+\|[^|]+\| ([\d.]+) \|$", table.partition("\n## ")[0], re.MULTILINE)
    assert shown[-len(pose_run.TESTS) :] == [f"{test.threshold:g}" for test in pose_run.TESTS]


@pytest.fixture(scope="module")
def make_reference() -> Any:
    spec = importlib.util.spec_from_file_location("make_reference", ROOT / "docs" / "make_reference.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", sorted(REFERENCE.rglob("*.md")), ids=ident)
def test_generated_tables_are_up_to_date(page, make_reference):
    text = page.read_text(encoding="utf-8")
    assert make_reference.updated(text) == text, "run: python docs/make_reference.py"


def reference(*names: str) -> str:
    return "".join(page.read_text(encoding="utf-8") for name in names for page in sorted(REFERENCE.glob(name)))


def generated(*names: str) -> list[str]:
    return [f"<!-- generated: {name} -->" for name in names]


OWN = [entry for entry in discover().rows if entry.origin.plugin == "photonpano" and entry.kind != "run-kind"]
FUNCTIONS = [name for name in photonpano.__all__ if inspect.isfunction(getattr(photonpano, name))]
HOOKS = [name for name in vars(hookspecs) if name.startswith("photonpano_")]
# Pages, and what must stand in them.
LISTED: dict[str, tuple[tuple[str, ...], list[str]]] = {
    "settings": (
        ("spec.md", "spec/*.md"),
        generated(*(f"settings {name}" for name in ("levels", "graph", "render", "output", "run"))),
    ),
    "components": (
        ("spec.md", "spec/*.md"),
        generated(*(f"{entry.kind} {entry.name}" for entry in OWN if entry.contribution.config.model_fields))
        + [f"\n## `{entry.name}`\n" for entry in OWN],
    ),
    "corrections": (
        ("spec.md", "spec/*.md"),
        generated("corrections", *(f"correction {name}" for name, model in CORRECTIONS.items() if model.model_fields)),
    ),
    "commands": (("cli.md",), generated(*(f"command {name}" for name in commands()))),
    "functions": (("python.md",), [f"| `{name}(" for name in FUNCTIONS if name != "discover"]),
    "hooks": (("plugins.md",), [f"\n## `{name}`\n" for name in HOOKS]),
}


@pytest.mark.parametrize("what", LISTED)
def test_reference_has_a_place_for_each(what):
    pages, wanted = LISTED[what]
    text = reference(*pages)
    assert wanted
    assert [each for each in wanted if each not in text] == []


def test_run_folder_page_documents_every_file_and_key(small_run):
    page = (REFERENCE / "run-folder.md").read_text(encoding="utf-8")
    record = small_run.record
    names = {file.name for file in small_run.directory.iterdir()}
    with np.load(small_run.directory / "trajectory.npz") as trajectory:
        names.update(trajectory.files)
    names.update(key for part in (record, record["source"], record["panorama"], *record["levels"]) for key in part)
    assert [name for name in sorted(names) if f"`{name}`" not in page] == []
