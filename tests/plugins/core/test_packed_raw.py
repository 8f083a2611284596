from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from photonpano import InputError, Piped, SourceContext
from photonpano_core.sources.packed_raw import PACKED_RAW, PackedRawConfig


def written(folder: Path, n_bytes: int) -> Path:
    path = folder / "capture.raw"
    path.write_bytes(np.random.default_rng(0).bytes(n_bytes))
    return path


@pytest.mark.parametrize(
    ("n_bytes", "keys", "message"),
    [
        (
            47,
            {},
            "{path} ends within a frame: after 3 frames of 15 bytes come 2 bytes more; correct height and width, or cut off "
            "the rest with `truncate -s 45 {path}`",
        ),
        (14, {}, "{path} has 14 bytes, and a frame of 5x20 px takes 15; correct height and width"),
        (
            45,
            {"header_bytes": 40},
            "{path} has 45 bytes, and a frame of 5x20 px takes 15 after 40 bytes; correct height and width",
        ),
    ],
)
def test_file_without_whole_frames_is_refused(tmp_path: Path, n_bytes: int, keys: dict[str, int], message: str) -> None:
    path = written(tmp_path, n_bytes)
    with pytest.raises(InputError) as caught:
        PACKED_RAW.build(PackedRawConfig(path=path, height=5, width=20, **keys), SourceContext())
    assert str(caught.value) == message.format(path=path)


def test_standard_input_is_for_following() -> None:
    config = PackedRawConfig(path="-", height=5, width=20, header_bytes=7)
    assert PACKED_RAW.arrived is not None
    assert PACKED_RAW.arrived(config) == Piped(header_bytes=7, frame_bytes=15)
    assert PACKED_RAW.check(config) == ()
    with pytest.raises(InputError, match="run with --follow, or name a file"):
        PACKED_RAW.build(config, SourceContext())
