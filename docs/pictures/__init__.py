"""The pictures of the README and of the docs, one module for the captures and runs that some have in common."""

from __future__ import annotations

from pathlib import Path

from harness import Study, scores_of


def finished(study: Study, name: str, spec: dict, capture: Path) -> Path:
    """Run a spec, print its scores, and return the run folder."""
    folder = study.run(name, spec)
    print(f"{name}: {'; '.join(f'{what} {value}' for what, value in scores_of(folder, capture).rows())}")
    return folder
