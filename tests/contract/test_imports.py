"""Importing is cheap: a library that is heavy is imported when a component is built, not before."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import photonpano
import photonpano.geometry
import photonpano.locating

# Libraries that take long to import; numpy is allowed.
HEAVY = {
    *("PIL", "aiohttp", "av", "cv2", "dask", "distributed", "fsspec", "h5py", "imageio", "kornia", "matplotlib", "numba"),
    *("numcodecs", "pandas", "pycolmap", "s3fs", "scipy", "skimage", "sklearn", "tifffile", "torch", "torchvision", "zarr"),
}
COMMANDS = ["--help", "plugins list", "plugins show direct", "schema", "check scan.yaml"]
ROOT = Path(__file__).parents[2]
SCRIPTS = sorted([*(ROOT / "tests" / "benchmarks").glob("*.py"), *(ROOT / "docs").glob("*.py")])
HOOKS = sorted(f"{path.parent.name}.hooks" for path in (ROOT / "plugins").glob("*/hooks.py"))
# One after the other in one process: what any of them imports is there at the end.
DISCOVERY = f"""
import {", ".join(HOOKS)}
import photonpano.geometry, photonpano.photometry, photonpano.api.cli
from photonpano.plugins.registry import discover; discover()
from photonpano import capture_plan, load_spec, parse_spec
"""
ALL_COMMANDS = f"""
import sys
from photonpano.api.cli import main
for arguments in {COMMANDS!r}:
    sys.argv[1:] = arguments.split()
    try:
        main()
    except SystemExit as ended:
        assert not ended.code, arguments
"""


def imported_by(statement: str, folder: Path | None = None) -> set[str]:
    """Return the top-level modules that a fresh interpreter holds when it has done a statement and ends."""
    tell = "import atexit, sys; atexit.register(lambda: print(*{name.split('.')[0] for name in sys.modules}, file=sys.stderr))"
    done = subprocess.run(
        [sys.executable, "-c", f"{tell}\n{statement}"], capture_output=True, text=True, check=True, cwd=folder
    )
    return set(done.stderr.split())


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_script_outside_the_suite_can_be_imported(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Benchmarks and the scripts of the docs take too long to run here, and are not to fall behind."""
    spec = importlib.util.spec_from_file_location(f"script_{script.stem}", script)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.syspath_prepend(str(script.parent))  # as Python does for a script
    monkeypatch.setitem(sys.modules, spec.name, module)  # as dataclasses look it up
    spec.loader.exec_module(module)


def test_package_imports_no_library() -> None:
    assert imported_by("import photonpano") & {*HEAVY, "numpy", "pydantic", "pluggy", "rich", "typer"} == set()


@pytest.mark.parametrize("package", [photonpano, photonpano.geometry, photonpano.locating], ids=lambda each: each.__name__)
def test_dir_of_lazy_package_lists_public_names(package: ModuleType) -> None:
    assert dir(package) == sorted(package.__all__)
    assert all(getattr(package, name) is not None for name in package.__all__)


def test_discovery_imports_no_heavy_library() -> None:
    assert len(HOOKS) == 10
    assert imported_by(DISCOVERY) & HEAVY == set()


def test_commands_without_run_import_no_heavy_library(tmp_path: Path) -> None:
    np.save(tmp_path / "cube.npy", np.zeros((2000, 16, 2), np.uint8))
    (tmp_path / "scan.yaml").write_text(
        "version: 1\nsource: {use: packed-npy, with: {path: cube.npy}}\nresample: {with: {group_size: 100}}\n"
    )
    loaded = imported_by(ALL_COMMANDS, tmp_path)
    assert "typer" in loaded
    assert loaded & HEAVY == set()
