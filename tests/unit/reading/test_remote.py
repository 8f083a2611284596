"""Captures at URLs: over HTTP, and in an object store."""

import gzip
import json
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, InputError, Url, discover, parse_spec, run
from photonpano.reading import read_range

FRAMES = np.random.default_rng(0).integers(0, 256, (3000, 64, 32), np.uint8)
FRAME_BYTES = 64 * 32


@pytest.fixture
def cube(tmp_path: Path) -> Path:
    (tmp_path / "store" / "bucket").mkdir(parents=True, exist_ok=True)
    np.save(tmp_path / "store" / "bucket" / "cube.npy", FRAMES)
    return tmp_path / "store" / "bucket" / "cube.npy"


@pytest.fixture
def server(file_server: Callable[..., Any], cube: Path) -> Any:
    with file_server(cube.parent) as server:
        yield server


def opened(url: object, use: str = "packed-npy", **keys: Any) -> Any:
    contribution = discover().find("source", use).contribution
    return contribution.build(contribution.config(path=Url(str(url)), **keys), None)


def problem(url: object, use: str = "packed-npy", **keys: Any) -> str:
    contribution = discover().find("source", use).contribution
    (found,) = contribution.check(contribution.config(path=Url(str(url)), **keys))
    return str(found)


def test_frames_over_http_are_those_of_the_file(server: Any) -> None:
    with opened(f"{server.address}/cube.npy") as source:
        assert source.info.n_frames == 3000
        for span in (FrameSpan(0, 3000), FrameSpan(2999, 3000), FrameSpan(2000, 2100)):
            np.testing.assert_array_equal(source.packed(span), FRAMES[span.start : span.stop])


def test_no_more_is_read_than_is_needed(server: Any) -> None:
    with opened(f"{server.address}/cube.npy") as source:
        server.requests.clear()
        source.counts(FrameSpan(1000, 1010))
        assert server.bytes_sent("cube.npy") == 10 * FRAME_BYTES


def test_a_capture_in_order_is_read_once(server: Any, cube: Path) -> None:
    with opened(f"{server.address}/cube.npy") as source:
        server.requests.clear()
        for span in source.info.span.blocks(7):
            source.counts(span)
        assert server.bytes_sent("cube.npy") <= cube.stat().st_size + 7 * FRAME_BYTES


def test_files_of_a_camera_are_found_in_a_bucket(object_store: Any, cube: Path) -> None:
    frames = np.random.default_rng(1).integers(0, 256, (12, 512, 64), np.uint8)
    (cube.parent / "scan").mkdir()
    for number, part in ((2, frames[:8]), (10, frames[8:])):
        (cube.parent / "scan" / f"f{number}.bin").write_bytes(part.tobytes())
    with opened("s3://bucket/scan", "spad512") as source:
        np.testing.assert_array_equal(source.packed(FrameSpan(0, 12)), frames)
    with opened(f"{object_store.address}/bucket/scan/f2.bin", "spad512") as source:
        assert source.info.n_frames == 8
    assert problem(f"{object_store.address}/bucket/scan", "spad512").endswith(
        "/bucket/scan is no .bin file, and files are not listed over http; name the file itself"
    )
    assert problem("s3://bucket/none", "spad512") == "there is no .bin file below s3://bucket/none; check the address"


def test_what_cannot_be_read_is_refused_with_the_way_out(server: Any, cube: Path, file_server: Callable[..., Any]) -> None:
    (cube.parent / "private").mkdir()
    address = server.address
    assert problem(f"{address}/none.npy") == f"there is no {address}/none.npy; check the server or bucket, and the path"
    assert problem(f"{address}/private/cube.npy").startswith(
        f"{address}/private/cube.npy may not be read: its server refuses access (403); give credentials in the environment"
    )
    with file_server(cube.parent, ranges=False) as other:
        assert problem(f"{other.address}/cube.npy") == (
            f"{other.address}/cube.npy cannot be read in parts: its server sends whole files only; download the file"
        )
    assert problem("moon://bucket/cube.npy") == (
        "moon://bucket/cube.npy has a scheme that nothing reads; captures are read from paths, and from s3://, gs://, http:// "
        "and https://"
    )
    cube.write_bytes(cube.read_bytes()[:100_000])
    assert problem(f"{address}/cube.npy").startswith(f"{address}/cube.npy is cut short: its header (3000, 64, 32) promises")
    cube.write_bytes(gzip.compress(b"something"))
    assert problem(f"{address}/cube.npy") == (
        f"{address}/cube.npy is not a .npy file: it is compressed with gzip; unpack it with gunzip"
    )
    cube.write_bytes(b"something else")
    assert problem(f"{address}/cube.npy").startswith(f"{address}/cube.npy is not a .npy file, by its first bytes")


def test_no_server_is_told_from_no_file() -> None:
    pytest.importorskip("aiohttp", reason="URLs need photonpano[http]")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}"
    assert problem(f"{address.replace('//', '//me:secret@')}/cube.npy?token=secret") == (
        f"cannot read {address}/cube.npy: no server answers at {address[7:]}; check the address and the network"
    )


@pytest.mark.parametrize(("scheme", "library", "extra"), [("s3", "s3fs", "s3"), ("https", "aiohttp", "http")])
def test_missing_extra_is_named(scheme: str, library: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(InputError) as caught:
        read_range(Url(f"{scheme}://bucket/cube.npy"), 0, 1)
    assert str(caught.value) == (
        f"{scheme}://bucket/cube.npy needs {library}, which is not installed: "
        f'pip install "photonpano[{extra}]" (in a checkout: pip install ".[{extra}]")'
    )


def test_finished_run_at_a_url_is_taken_while_unchanged_and_records_no_secrets(
    server: Any, cube: Path, small_capture: Path, small_spec: dict[str, Any], tmp_path: Path
) -> None:
    cube.write_bytes(small_capture.read_bytes())
    secret = server.address.replace("//", "//me:secret@") + "/cube.npy?token=secret"
    spec = small_spec | {"source": {"use": "packed-npy", "with": {"path": secret}}, "levels": 1, "refine": []}
    plan = parse_spec(spec, output=tmp_path / "run")
    run(plan)
    record = json.loads((tmp_path / "run" / "run.json").read_text())
    assert record["spec"]["source"]["with"]["path"] == f"{server.address}/cube.npy"
    texts = [path.read_bytes() for path in (tmp_path / "run").rglob("*") if path.is_file()]
    assert not any(b"secret" in text for text in texts)
    assert record["capture"]["files"][0]["path"] == f"{server.address}/cube.npy"
    assert run(plan, resume=True).was_finished
    frames = np.load(small_capture)
    frames[0] ^= 0xFF
    np.save(cube, frames)
    assert not run(plan, resume=True).was_finished, "the capture has changed"
    default = parse_spec(small_spec, overrides=[f"source.with.path={secret}"]).output.directory
    assert default.name == f"spec-{server.address[7:]}-cube"
