"""Describe what a run was made with: components, versions of libraries, memory."""

from __future__ import annotations

import importlib.metadata
import re
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from photonpano.record.schema import PluginRecord
from photonpano.specs.plan import Choice, Plan

_LIBRARIES = ("numpy", "numba", "opencv-python-headless", "scipy", "pydantic", "pluggy", "tifffile")


def plugin_records(plan: Plan) -> list[PluginRecord]:
    """List the components of a plan, each once."""
    seen: dict[tuple[str, str], PluginRecord] = {}
    for stage, choice in _choices(plan):
        name = choice.contribution.name
        seen[stage, name] = {"stage": stage, "use": name, "plugin": choice.origin.plugin, "version": choice.origin.version}
    return list(seen.values())


def library_versions(plan: Plan) -> dict[str, str]:
    """Return the versions of Python and of the libraries that the result depends on."""
    versions = {"python": sys.version.split()[0]}
    required = [requirement.module for _, choice in _choices(plan) for requirement in choice.contribution.requires]
    for name in dict.fromkeys((*_LIBRARIES, *required)):
        # The distribution may have another name than the module.
        with suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def peak_memory_bytes() -> int | None:
    """Return the largest resident size of this process so far; None where the system does not report it."""
    status = Path("/proc/self/status")
    # On Linux, getrusage returns the size of the parent process if that was larger.
    if status.exists() and (found := re.search(r"VmHWM:\s*(\d+) kB", status.read_text(encoding="ascii", errors="replace"))):
        return 1024 * int(found[1])
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _choices(plan: Plan) -> Iterator[tuple[str, Choice]]:
    """Yield the sections of a spec with the component that each chooses, level by level."""
    yield "source", plan.source
    if plan.pose is not None:
        yield "pose", plan.pose
        return
    for level in plan.levels:
        yield from (("resample", level.resample), ("merge", level.merge), ("locate", level.locate))
        yield from (("locate", choice) for choice in level.fallbacks)
        yield "interpolate", level.interpolate
    yield from (("refine", choice) for choice in plan.refine)
    yield "render", plan.renderer
    yield from (("output", choice) for choice in plan.formats)
