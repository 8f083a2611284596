"""Run single checks of the kit on components, most of them broken on purpose."""

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
    """No keys."""


def cases(check: Callable, kit: Any) -> Iterator[dict[str, Any]]:
    """Yield the arguments with which pytest would call a check."""
    if "motion" in inspect.signature(check).parameters:
        yield from ({"motion": motion} for motion in kit.motions)
        return
    marks = [mark for mark in getattr(check, "pytestmark", ()) if mark.name == "parametrize"]
    yield from ({marks[0].args[0]: value} for value in marks[0].args[1]) if marks else [{}]


@pytest.fixture(scope="session")
def checks_of() -> Callable[..., set[str]]:
    """Return the names of the checks of a class of the kit, without those of another class that it inherits from."""

    def checks_of(kit: type, beside: type = object) -> set[str]:
        return {name for name in set(dir(kit)) - set(dir(beside)) if name.startswith("test_")}

    return checks_of


@pytest.fixture
def failure(tmp_path: Path) -> Callable[..., str | None]:
    """Run a check on the component that `build(context)` returns; return its message, or None if it passes.

    `record` holds fields of the contribution; other keywords are attributes of the class of the kit.
    """

    def failure(kit: type, check: str, build: Any, record: dict[str, Any] | None = None, **attributes: Any) -> str | None:
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

    return failure


@pytest.fixture
def catches(failure: Callable[..., str | None]) -> Callable[..., None]:
    """Require that a check fails with a message that matches: `catches(kit, check, build, words)`."""

    def catches(kit: type, check: str, build: Any, words: str, **attributes: Any) -> None:
        found = failure(kit, check, build, **attributes)
        assert found is not None, f"{check} passes"
        assert re.search(words, found), found

    return catches
