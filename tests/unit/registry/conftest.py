"""Distributions that are as good as installed: a folder on `sys.path` with a real `.dist-info`."""

import importlib
import sys
from collections.abc import Callable
from textwrap import dedent

import pytest

HEADER = """
from photonpano import *

class Keys(Config):
    pass

def unbuilt(config, context):
    raise AssertionError("nothing is built during discovery")

def source(name, **more):
    return SourceContribution(name=name, summary="A toy", config=Keys, build=unbuilt, **more)

def locator(name, **more):
    return LocatorContribution(name=name, summary="A toy", config=Keys, build=unbuilt, **more)
"""


@pytest.fixture
def install(tmp_path, monkeypatch) -> Callable[..., None]:
    """Install a distribution with one hook module: `install("alpha", "1.0", "code of the hook module")`."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delenv("PHOTONPANO_DISABLE_PLUGINS", raising=False)

    def install(name: str, version: str, code: str, metadata: bool = True, distribution: str = "") -> None:
        module = f"{name}_hooks"
        monkeypatch.delitem(sys.modules, module, raising=False)
        (tmp_path / f"{module}.py").write_text(HEADER + dedent(code))
        distribution = distribution or name
        info = tmp_path / f"{distribution.replace('-', '_')}-{version}.dist-info"
        info.mkdir()
        (info / "entry_points.txt").write_text(f"[photonpano]\n{name} = {module}\n")
        if metadata:
            (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: {version}\n")
        importlib.invalidate_caches()

    yield install
    for module in [each for each in sys.modules if each.endswith("_hooks")]:
        del sys.modules[module]
