"""Texts, paths, files that appear whole, and filters."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from photonpano import (
    Config,
    OutputError,
    SpecLocation,
    SpecPath,
    Url,
)
from photonpano import text as words
from photonpano.files.folders import atomic_path
from photonpano.files.paths import location
from photonpano.filtering import exceeding_noise


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


@pytest.mark.parametrize(
    ("value", "text"), [(1, "100 %"), (0.998, "over 99 %"), (0.934, "93 %"), (0.003, "under 1 %"), (0, "0 %")]
)
def test_share_is_exact_at_0_and_100_percent_only(value, text):
    assert words.share(value) == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("s3://bucket/night/cube.npy", "s3://bucket/night/cube.npy"),
        ("s3:/bucket/cube.npy", "s3://bucket/cube.npy"),
        ("https://me:secret@host:8000/a/cube.npy?X-Signature=secret#1", "https://host:8000/a/cube.npy"),
        ("s3://me:secret@bucket/what?.npy", "s3://bucket/what?.npy"),
    ],
)
def test_urls_are_shown_without_their_secrets(text: str, shown: str) -> None:
    url = location(text)
    assert isinstance(url, Url)
    assert str(url) == shown
    assert "secret" not in repr(url)
    assert location(Path(text)) == location(str(Path(text)))


class Opens(Config):
    path: SpecLocation
    mask: SpecPath | None = None


def test_urls_in_configs_keep_their_secrets_and_records_do_not() -> None:
    config = Opens.model_validate_json('{"path": "https://me:secret@host/cube.npy"}', context={"directory": Path("/specs")})
    assert config.path == Url("https://me:secret@host/cube.npy")
    assert config.model_dump(mode="json")["path"] == "https://host/cube.npy"
    assert Opens.model_validate_json('{"path": "cube.npy"}', context={"directory": Path("/specs")}).path == Path(
        "/specs/cube.npy"
    )


def test_atomic_path_creates_the_file_when_the_block_ends(tmp_path: Path) -> None:
    final = tmp_path / "result.bin"
    with atomic_path(final) as temporary:
        temporary.write_bytes(b"half")
        assert not final.exists()
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".bin"
        temporary.write_bytes(b"whole")
    assert final.read_bytes() == b"whole"
    assert list(tmp_path.iterdir()) == [final]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_atomic_path_keeps_the_old_file_on_failure(tmp_path: Path, error: type[BaseException]) -> None:
    final = tmp_path / "result.bin"
    final.write_bytes(b"old")
    with pytest.raises(error), atomic_path(final) as temporary:
        raise error(temporary.write_bytes(b"new"))
    assert final.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [final]


def test_atomic_path_refuses_a_folder_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(OutputError) as caught, atomic_path(tmp_path):
        raise AssertionError("the block must not run")
    assert str(caught.value) == f"cannot write {tmp_path}: Is a directory; choose another name, or remove the folder"


def test_atomic_path_reports_a_full_disk_and_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is found to be full when the whole file is flushed, as some file systems do."""

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    final = tmp_path / "result.bin"
    final.write_bytes(b"old")
    monkeypatch.setattr("photonpano.files.folders.os.fsync", full)
    with pytest.raises(OutputError) as caught, atomic_path(final) as temporary:
        temporary.write_bytes(b"new")
    assert str(caught.value) == (f"cannot write {final}: No space left on device; free some space or choose another folder")
    assert final.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [final]


STEPS = np.arange(1000)


def noise(seed: int, std: float = 0.3) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, std, len(STEPS))


@pytest.mark.parametrize("seed", range(3))
def test_noise_alone_is_left_out(seed: int) -> None:
    filtered = exceeding_noise(noise(seed), np.full(len(STEPS), 0.3**2))
    assert np.sqrt(np.mean(filtered.signal**2)) < 0.03
    assert filtered.std.max() < 0.1


@pytest.mark.parametrize("seed", range(3))
def test_tremor_is_kept_and_its_noise_known(seed: int) -> None:
    tremor = np.sin(2 * np.pi * STEPS / 11) + 0.5 * np.sin(2 * np.pi * STEPS / 37)
    filtered = exceeding_noise(tremor + noise(seed), np.full(len(STEPS), 0.3**2))
    error = np.sqrt(np.mean((filtered.signal - tremor) ** 2))
    assert error < 0.15
    assert 0.5 < error / np.sqrt(np.mean(filtered.std**2)) < 2
