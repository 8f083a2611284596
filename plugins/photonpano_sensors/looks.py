"""First looks at files, in processes of their own: see `photonpano.reading.look_first`. They import one library each."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import Any, TypeVar

ItemT = TypeVar("ItemT")

_MOST = 16  # about how many frames of a file, or files of a capture, are read


def spread(items: Sequence[ItemT]) -> Sequence[ItemT]:
    """Return all of a few items, and about 16 evenly spaced ones of more."""
    return items[:: max(1, len(items) // _MOST)]


def ubicept(path: str) -> None:
    """Read some frames of a .ubi.h5 file."""
    import h5py

    def group_of_frame(name: str, item: Any) -> Any:
        return item.parent if isinstance(item, h5py.Dataset) and name.rpartition("/")[2].isdigit() else None

    with h5py.File(path) as file:
        group = file.visititems(group_of_frame)
        names = [name for name in group if name.isdigit()]
        group[names[0]].attrs.get("metadata")
        for name in spread(names):
            group[name][()]


def matlab(path: str) -> None:
    """Read some frames of a file of MATLAB 7.3."""
    import h5py

    with h5py.File(path) as file:
        values = file["OUTPUT"]
        for index in spread(range(len(values))):
            values[index]


def tiff(path: str) -> None:
    """Read the headers of all pages of a TIFF file, and some pages."""
    import tifffile

    with tifffile.TiffFile(path) as file:
        for page in file.pages:
            _ = page.aspage().bitspersample
        for index in spread(range(len(file.pages))):
            file.pages[index].asarray()


def tiff_picture(path: str) -> None:
    """Read a TIFF file that is one frame, as the source does: the header with tifffile, the levels with OpenCV."""
    import cv2

    tiff(path)
    cv2.imread(path, cv2.IMREAD_UNCHANGED)


def video(path: str) -> None:
    """Read some packets of a video, and decode the frames at its beginning and in its middle."""
    import av

    with av.open(path, metadata_errors="replace") as container:
        stream = container.streams.video[0]
        packets = [packet.pts or 0 for packet in islice(container.demux(stream), 50 * _MOST)]
        for time in (0, packets[len(packets) // 2]):
            container.seek(time, stream=stream)
            for _ in islice(container.decode(stream), _MOST):
                pass
