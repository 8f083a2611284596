"""Runs single checks of the kit on components, most of which are broken on purpose."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from photonpano import Config
from photonpano.registry import KINDS


class NoKeys(Config):
    """Nothing to choose."""


def cases(check: Callable, kit: Any) -> Iterator[dict[str, Any]]:
    """Yield the arguments with which pytest would call a check."""
    if "motion" in inspect.signature(check).parameters:
        yield from ({"motion": motion} for motion in kit.motions)
        return
    marks = [mark for mark in getattr(check, "pytestmark", ()) if mark.name == "parametrize"]
    yield from ({marks[0].args[0]: value} for value in marks[0].args[1]) if marks else [{}]


@pytest.fixture(scope="session")
def checks_of() -> Callable[..., set[str]]:
    """Return the names of the checks of a class of the kit, without those that it inherits from another."""

    def checks_of(kit: type, beside: type = object) -> set[str]:
        return {name for name in set(dir(kit)) - set(dir(beside)) if name.startswith("test_")}

    return checks_of


@pytest.fixture
def complaint(tmp_path: Path) -> Callable[..., str | None]:
    """Run a check on what `build(context)` makes, and return what it complains of; None if it is content.

    `record` holds fields of the contribution; other keywords are attributes of the class of the kit.
    """

    def complaint(kit: type, check: str, build: Any, record: dict[str, Any] | None = None, **attributes: Any) -> str | None:
        fields = {"name": "toy", "summary": "A toy", "config": NoKeys, "build": lambda _, context: build(context)}
        contribution = KINDS[kit.kind].contribution(**fields | (record or {}))
        subject = type("TestToy", (kit,), {"contribution": contribution, **attributes})()
        if hasattr(subject, "prepare"):
            subject.prepare(tmp_path)
        for arguments in cases(getattr(subject, check), subject):
            try:
                getattr(subject, check)(**arguments)
            except AssertionError as error:
                return str(error)
        return None

    return complaint


@pytest.fixture
def catches(complaint: Callable[..., str | None]) -> Callable[..., None]:
    """Require that a check complains, in words that match: `catches(kit, check, build, words)`."""

    def catches(kit: type, check: str, build: Any, words: str, **attributes: Any) -> None:
        found = complaint(kit, check, build, **attributes)
        assert found is not None, f"{check} is content"
        assert re.search(words, found), found

    return catches
