"""A process of its own looks at files first: what a damaged file does there becomes one sentence."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from photonpano import InputError
from photonpano.reading import first_look, look_first

LOOKS = """\
import os
from pathlib import Path

def loop(path):
    while True:
        pass

def crash(path):
    if path.endswith("2"):
        os.abort()

def take_memory(path):
    bytearray(3 * 2**30)

def fail(path):
    raise ValueError("for the reader to say")

def note(path):
    with Path(path + ".seen").open("a") as file:
        file.write("x")
"""


@pytest.fixture
def look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., str]:
    """Look at two files, and return what is wrong with them."""
    (tmp_path / "looks_of_test.py").write_text(LOOKS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(first_look, "CPU_S", 0.5)
    paths = [tmp_path / name for name in ("1", "2")]
    for path in paths:
        path.write_bytes(b"content")

    def look(name: str) -> str:
        try:
            look_first(paths, f"looks_of_test:{name}")
        except InputError as error:
            return str(error)
        return ""

    return look


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("loop", "DIR/1 cannot be read to an end: it is damaged; copy or record it again"),
        ("crash", "DIR/2 makes its reader crash (SIGABRT): it is damaged; copy or record it again"),
        ("take_memory", "DIR/1 takes more than 2 GiB of memory to read: it is damaged; copy or record it again"),
        ("fail", ""),
    ],
)
def test_look_names_the_file_that_cannot_be_read(tmp_path: Path, look: Callable[..., str], name: str, message: str) -> None:
    assert look(name) == message.replace("DIR", str(tmp_path))


def test_file_is_looked_at_once_unless_it_changes(tmp_path: Path, look: Callable[..., str]) -> None:
    assert look("note") == look("note") == ""
    assert (tmp_path / "1.seen").read_text() == "x"
    (tmp_path / "1").write_bytes(b"other content")
    look("note")
    assert (tmp_path / "1.seen").read_text() == "xx"


def test_reader_goes_on_if_no_process_can_be_started(look: Callable[..., str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_look.sys, "executable", "/nowhere/python")
    assert look("crash") == ""


def test_verdict_tells_a_limit_from_a_crash() -> None:
    assert first_look._verdict(-signal.SIGPROF, 0) == first_look._verdict(-signal.SIGKILL, 0) == "cannot be read to an end"
    assert first_look._verdict(3, 0) == "makes its reader crash (exit code 3)"
