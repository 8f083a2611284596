"""Interrupts by a signal are told from those that code raises."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator

import pytest

from photonpano.errors import described
from photonpano.interrupts import is_interrupt


@pytest.mark.usefixtures("heeded")
def test_keyboard_interrupt_is_interrupt_only_after_signal() -> None:
    assert not is_interrupt(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt) as caught:
        signal.raise_signal(signal.SIGINT)
    assert is_interrupt(caught.value)
    assert not is_interrupt(SystemExit(0))


@pytest.fixture
def default_handler() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("default_handler")
def test_without_handler_keyboard_interrupt_counts_in_main_thread_alone() -> None:
    seen = [is_interrupt(KeyboardInterrupt())]
    thread = threading.Thread(target=lambda: seen.append(is_interrupt(KeyboardInterrupt())))
    thread.start()
    thread.join()
    assert seen == [True, False]


class Mute(BaseException):
    def __str__(self) -> str:
        raise RuntimeError("no words")


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (ValueError("too dark"), "ValueError: too dark"),
        (SystemExit(), "SystemExit"),
        (Mute(), "Mute: (its message cannot be written)"),
    ],
)
def test_described_exception_has_type_and_message(error: BaseException, text: str) -> None:
    assert described(error) == text
