from __future__ import annotations

import pytest

from photonpano import text as words


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
    assert words.duration(seconds) == text


@pytest.mark.parametrize(("hertz", "text"), [(96_800, "96.8 kHz"), (500, "500 Hz"), (1.5e6, "1.5 MHz"), (29.97, "30 Hz")])
def test_rate_formats_hz_khz_mhz(hertz, text):
    assert words.rate(hertz) == text


@pytest.mark.parametrize(
    ("size", "text"), [(512, "512 B"), (812 * 2**20, "812 MiB"), (1023 * 2**20, "1 GiB"), (3 * 2**29, "1.5 GiB")]
)
def test_byte_size_has_the_unit_that_fits(size, text):
    assert words.byte_size(size) == text


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "\N{EN DASH}"), (0.0, "0"), (0.0631, "0.063"), (1.834, "1.83"), (12.34, "12.3"), (1234.5, "1,234")],
)
def test_pixels_has_two_digits_below_a_tenth_and_a_dash_for_none(value, text):
    assert words.pixels(value) == text


@pytest.mark.parametrize(
    ("value", "text"), [(1, "100 %"), (0.998, "over 99 %"), (0.934, "93 %"), (0.003, "under 1 %"), (0, "0 %")]
)
def test_share_is_exact_at_0_and_100_percent_only(value, text):
    assert words.share(value) == text


def test_count_counted_and_span_format_whole_numbers():
    assert words.counted(1, "frame") == "1 frame"
    assert words.counted(12_000, "frame") == "12,000 frames"
    assert words.span(1000, 2000) == "1,000 to 1,999"
    assert words.span(7, 8) == "7"
