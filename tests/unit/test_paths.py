from __future__ import annotations

from pathlib import Path

import pytest

from photonpano import Config, SpecLocation, SpecPath, Url
from photonpano.paths import location


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


@pytest.mark.parametrize("text", ["cube.npy", "/data/cube.npy", "C:/cube.npy", "night:1/cube.npy", "s3:", "a::b"])
def test_paths_are_no_urls(text: str) -> None:
    assert location(text) == Path(text)


def test_parts_of_a_url() -> None:
    url = Url("https://me:secret@host/a/cube.zarr?token=secret")
    assert (url.scheme, url.host, url.name, url.stem, url.suffix) == ("https", "host", "cube.zarr", "cube", ".zarr")
    assert (url / "zarr.json").address == "https://me:secret@host/a/cube.zarr/zarr.json?token=secret"
    assert Url("s3://bucket").name == ""
    assert (Url("s3://bucket/folder/") / "c.0").address == "s3://bucket/folder/c.0"


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


def test_keys_for_files_refuse_urls() -> None:
    with pytest.raises(ValueError, match=r"s3://bucket/mask.npy is a URL, and this must be a file: download it"):
        Opens.model_validate_json('{"path": "cube.npy", "mask": "s3://bucket/mask.npy"}')
