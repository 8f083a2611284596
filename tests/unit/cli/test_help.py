from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest

import photonpano
from photonpano.cli.app import commands

HEAVY = {"numpy", "pydantic", "cv2", "scipy", "skimage", "matplotlib", "rich", "photonpano_core", "photonpano_opencv"}


@pytest.fixture(autouse=True)
def narrow_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")


COMMANDS = commands()


def test_help_imports_nothing_heavy(program: list[str]) -> None:
    script = f"import sys, atexit; atexit.register(lambda: print(*sys.modules, file=sys.stderr)); {program[-1]}"
    done = subprocess.run([sys.executable, "-c", script, "--help"], capture_output=True, text=True, check=True)
    assert "Make a panorama from a spec." in done.stdout
    loaded = {module.partition(".")[0] for module in done.stderr.split()}
    assert "typer" in loaded
    assert not loaded & HEAVY


def test_commands_are_complete() -> None:
    assert set(COMMANDS) == {
        "run",
        "batch",
        "check",
        "check-run",
        "render",
        "video",
        "verify",
        "explain",
        "info",
        "preview",
        "convert",
        "export",
        "simulate",
        "dark",
        "evaluate",
        "compare",
        "clean",
        "schema",
        "warm-up",
        "plugins list",
        "plugins show",
    }


@pytest.mark.parametrize("name", COMMANDS)
def test_help_explains_every_option_and_its_example_parses(name: str, invoke: Callable[..., Any]) -> None:
    command = COMMANDS[name]
    assert [parameter.name for parameter in command.params if not parameter.help] == []
    words = name.split()
    text = invoke(*words, "--help").stdout
    assert all(len(line) <= 80 for line in text.splitlines())
    examples = [line.split("Example: ")[1] for line in command.help.splitlines() if "Example: " in line]
    assert len(examples) == 1
    program, *arguments = shlex.split(examples[0].partition(" > ")[0])
    assert (program, *arguments[: len(words)]) == ("photonpano", *words)
    with command.make_context(words[-1], arguments[len(words) :]):
        pass


def test_short_help_is_not_cut(invoke: Callable[..., Any]) -> None:
    assert "..." not in invoke("--help").stdout.replace("[ARGS]...", "")
    assert "..." not in invoke("plugins", "--help").stdout.replace("[ARGS]...", "")


def test_version_is_printed(invoke: Callable[..., Any]) -> None:
    assert invoke("--version").stdout == f"photonpano {photonpano.__version__}\n"


def test_module_is_the_program() -> None:
    done = subprocess.run([sys.executable, "-m", "photonpano", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"photonpano {photonpano.__version__}\n"
