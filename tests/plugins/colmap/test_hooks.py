"""How the plugin is listed without its library."""

from __future__ import annotations

import sys

import pytest

from photonpano import discover


def test_locator_is_listed_with_install_hint_if_library_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    assert discover().find("locator", "pycolmap-two-view").unavailable == (
        "the locator 'pycolmap-two-view' needs pycolmap, which is not installed: "
        'pip install "photonpano[colmap]" (in a checkout: pip install ".[colmap]")'
    )
