"""Importing is cheap: a library that is heavy is imported when a component is built, not before."""

from __future__ import annotations

import subprocess
import sys

import pytest

HEAVY = ("cv2", "numba", "pycolmap", "scipy", "skimage", "matplotlib", "tifffile")


def imported_by(statement: str) -> set[str]:
    """Return the top-level modules that a fresh interpreter holds after a statement."""
    code = f"{statement}\nimport sys; print(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_the_package_imports_nothing_at_all() -> None:
    assert imported_by("import photonpano") & {*HEAVY, "numpy", "pydantic", "pluggy", "rich", "typer"} == set()


@pytest.mark.parametrize(
    "statement",
    [
        "import photonpano_colmap.hooks",
        "import photonpano_core.hooks",
        "import photonpano_opencv.hooks",
        "import photonpano_simulator.hooks",
        "from photonpano.registry import discover; discover()",
        "import photonpano.cli",
    ],
)
def test_what_plugins_offer_is_told_without_their_libraries(statement: str) -> None:
    assert imported_by(statement) & set(HEAVY) == set()
