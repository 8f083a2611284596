from __future__ import annotations

import pytest

from photonpano.report import numbers
from photonpano.report.failures import failure_groups
from photonpano.text import byte_size


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 µs"),
        (0.000_25, "250 µs"),
        (0.1033, "103 ms"),
        (0.0421, "42.1 ms"),
        (8.25, "8.25 s"),
        (59.9, "59.9 s"),
        (59.96, "1 min 00 s"),
        (83.2, "1 min 23 s"),
        (3599.7, "1 h 00 min"),
        (7380, "2 h 03 min"),
    ],
)
def test_duration_formats_with_unit_and_three_digits(seconds, text):
    assert numbers.duration(seconds) == text


@pytest.mark.parametrize(("hertz", "text"), [(96_800, "96.8 kHz"), (500, "500 Hz"), (1.5e6, "1.5 MHz"), (29.97, "30 Hz")])
def test_rate_formats_hz_khz_mhz(hertz, text):
    assert numbers.rate(hertz) == text


@pytest.mark.parametrize(
    ("size", "text"), [(512, "512 B"), (812 * 2**20, "812 MiB"), (1023 * 2**20, "1 GiB"), (3 * 2**29, "1.5 GiB")]
)
def test_memory(size, text):
    assert byte_size(size) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "\N{EN DASH}"), (0.0, "0"), (0.0631, "0.063"), (1.834, "1.83"), (12.34, "12.3"), (1234.5, "1,234")],
)
def test_pixels(value, text):
    assert numbers.pixels(value) == text


@pytest.mark.parametrize(
    ("value", "text"), [(1, "100 %"), (0.998, "over 99 %"), (0.934, "93 %"), (0.003, "under 1 %"), (0, "0 %")]
)
def test_shares(value, text):
    assert numbers.share(value) == text


def test_count_counted_and_span_format_whole_numbers():
    assert numbers.counted(1, "frame") == "1 frame"
    assert numbers.counted(12_000, "frame") == "12,000 frames"
    assert numbers.span(1000, 2000) == "1,000 to 1,999"
    assert numbers.span(7, 8) == "7"


def failure(start: int, reason: str) -> dict:
    return {"moving": [start, start + 5], "fixed": [start + 5, start + 10], "reason": reason}


def test_failure_groups_ignore_numbers_in_reasons():
    levels = [
        {"level": 1, "failures": [failure(0, "too dark"), *(failure(k, f"only {k} of -3.5 agree") for k in range(5))]},
        {"level": 2, "failures": [failure(9, "too dark"), failure(19, "too dark")]},
    ]
    groups = failure_groups(levels)
    assert [(group.level, len(group.failures), group.reason) for group in groups] == [
        (1, 5, "only 0 of -3.5 agree"),
        (1, 1, "too dark"),
        (2, 2, "too dark"),
    ]
    assert [group.alike for group in groups] == [False, True, True]
    assert [group.more for group in groups] == [2, 0, 0]
    assert [pair["moving"][0] for pair in groups[0].examples] == [0, 1, 2]
