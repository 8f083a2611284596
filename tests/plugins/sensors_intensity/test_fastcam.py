from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from photonpano import InputError
from photonpano_sensors.intensity.contributions import FastcamMrawConfig
from photonpano_sensors.intensity.mraw import FastcamMrawSource, read_header
from photonpano_sensors.intensity.source import Encoding

REAL = Path(__file__).parents[2] / "data" / "photron"
BEAM, CIH = (REAL / "beam.cihx").read_bytes(), (REAL / "sample_60k_16bit.cih").read_bytes()
# What headers are damaged with, beside bytes by chance.
PIECES = [b"-1", b"1e999", b"\xb2", b"<cih>", b"&x;", b" : "]


@pytest.mark.parametrize("name", ["beam", "ball_12bit"])
@pytest.mark.filterwarnings("ignore::UserWarning")  # pyMRAW warns of recordings that it was not made for
def test_frames_equal_those_of_pymraw(name: str) -> None:
    reader = pytest.importorskip("pyMRAW")
    known, _ = reader.load_video(str(REAL / f"{name}.cihx"))
    with FastcamMrawSource(FastcamMrawConfig(path=REAL / f"{name}.mraw")) as source:
        np.testing.assert_array_equal(source.frames(source.info.span), known)
        np.testing.assert_array_equal(source.counts(source.info.span), known.sum(axis=0, dtype=np.uint32))


def test_header_gives_size_bits_and_rate() -> None:
    header = read_header(REAL / "ball_12bit.cihx")
    assert (header.n_frames, header.height, header.width, header.bits) == (3, 384, 384, 12)
    assert (header.encoding, header.frame_rate_hz) == (Encoding.full(12), 30_000)
    header = read_header(REAL / "sample_60k_16bit.cih")
    assert (header.n_frames, header.height, header.width, header.bits) == (12, 368, 896, 16)
    assert header.encoding == Encoding.full(12)
    assert header.frame_rate_hz == 60_000 / 36  # one frame in 36 was saved


def test_levels_in_the_higher_bits_are_scaled(tmp_path: Path) -> None:
    (tmp_path / "a.cih").write_bytes(CIH.replace(b"EffectiveBit Side : Lower", b"EffectiveBit Side : Higher"))
    assert read_header(tmp_path / "a.cih").encoding == Encoding(16, 0, 0xFFF0)


@pytest.mark.parametrize("bits", [12, 16])
def test_8_effective_bits_in_16_bit_pixels_are_read(tmp_path: Path, bits: int) -> None:
    levels = np.random.default_rng(0).integers(0, 256, (3, 4, 6), dtype=np.uint16)
    stored = levels.astype("<u2").tobytes()
    if bits == 12:
        first, second = levels.reshape(-1, 2).T
        stored = np.stack([first >> 4, (first & 15) << 4 | second >> 8, second & 255], axis=1).astype(np.uint8).tobytes()
    keys = {"Image Width": 6, "Image Height": 4, "Total Frame": 3, "Color Bit": bits, "File Format": "MRaw"}
    keys |= {"EffectiveBit Depth": 8, "EffectiveBit Side": "Lower"}
    (tmp_path / "a.cih").write_text("".join(f"{key} : {value}\n" for key, value in keys.items()))
    (tmp_path / "a.mraw").write_bytes(stored)
    with FastcamMrawSource(FastcamMrawConfig(path=tmp_path / "a.mraw")) as source:
        np.testing.assert_array_equal(source.frames(source.info.span), levels)
        assert source.response.saturation_level == 255


def test_xml_entities_are_not_expanded(tmp_path: Path) -> None:
    """A document type is cut off, or makes the header a damaged one."""
    entities = b'<!DOCTYPE a [<!ENTITY a "999"><!ENTITY b "&a;&a;"><!ENTITY c "&b;&b;">]>'
    bomb = BEAM.replace(b"<cih>", entities + b"<cih>", 1).replace(b"<width>1024</width>", b"<width>&c;</width>")
    (tmp_path / "a.cihx").write_bytes(bomb)
    with pytest.raises(InputError, match="undefined entity"):
        read_header(tmp_path / "a.cihx")


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """Draw a header of which parts were overwritten, cut out or repeated."""
    content = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(content)))
        stop = min(len(content), start + draw(st.integers(0, 40)))
        content[start:stop] = draw(st.binary(max_size=20) | st.sampled_from(PIECES))
    return bytes(content)


@pytest.mark.parametrize(("suffix", "whole"), [(".cihx", BEAM), (".cih", CIH)])
@settings(
    max_examples=int(os.environ.get("FUZZ_EXAMPLES", "150")),
    deadline=None,
    derandomize="FUZZ_EXAMPLES" not in os.environ,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(data=st.data())
def test_damaged_header_raises_input_error_only(suffix: str, whole: bytes, data: st.DataObject) -> None:
    texts = st.text(max_size=300).map(lambda text: f"<cih>{text}</cih>".encode())
    content = data.draw(damaged(whole) | st.binary(max_size=300) | texts)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        path.write_bytes(content)
        try:
            header = read_header(path)
        except InputError:
            return
    assert header.n_frames > 0
    assert header.frame_bytes > 0
    assert header.encoding.black < header.encoding.white < 2**header.encoding.bits
    assert header.frame_rate_hz is None or header.frame_rate_hz > 0
