"""Write pictures as a folder of PNGs, an MP4, or an animated WebP or GIF; and metadata (GPano) of a spherical picture."""

from __future__ import annotations

import importlib.util
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from photonpano.errors import OutputError
from photonpano.files.folders import atomic_folder, atomic_path
from photonpano.geometry import Canvas
from photonpano.plugins.contributions import Requirement, install_command
from photonpano.values import BoolArray

Picture = NDArray[np.uint8] | NDArray[np.uint16]  # of 16 bits in a folder of PNGs only

MOST_ANIMATED = 500  # pictures of an animated WebP or GIF, which is made in memory
_MOST_H264_PX = 16_384
_ANIMATED = {".webp": "WebP", ".gif": "GIF"}
_WEBP_QUALITY, _CRF = 90, "18"  # quality of lossy compression, whose errors are hardly visible
# Bytes of a PNG's signature and of its first chunk, IHDR.
_HEADER = 8 + 25
_KEYWORD = b"XML:com.adobe.xmp"


def require_writable(path: Path, n_pictures: int) -> None:
    """Raise an `OutputError` if `write_pictures` cannot write a name: its suffix, too many pictures, or a missing library."""
    if path.suffix not in ("", ".mp4", *_ANIMATED):
        raise OutputError(
            f"cannot write {path}: pictures go to a folder, as PNGs, or to a file that ends in .mp4, .webp or .gif"
        )
    if path.suffix in _ANIMATED and n_pictures > MOST_ANIMATED:
        raise OutputError(
            f"cannot write {path}: {n_pictures:,} pictures are too many for an animated {_ANIMATED[path.suffix]}, which holds "
            f"{MOST_ANIMATED}; take fewer, or write an .mp4"
        )
    if path.suffix == ".mp4" and importlib.util.find_spec("av") is None:
        install = install_command([Requirement("av", "photonpano[video]")])
        raise OutputError(f"cannot write {path}: videos need av, which is not installed: {install}")


def write_pictures(path: Path, pictures: Iterable[Picture], names: Sequence[str], fps: float) -> None:
    """Write pictures of one size, (H, W) or (H, W, 3) with red first; uint8, or uint16 into a folder.

    The path is a folder for PNGs, see `atomic_folder`, or a film that ends in .mp4, .webp or .gif. `names` are those of the
    PNGs, without suffix, as many as there are pictures; a GIF counts the time of a picture in 1/100 s.

    Raises:
        OutputError: see `require_writable`; or the files cannot be written. Nothing is left then.
    """
    require_writable(path, len(names))
    if path.suffix == "":
        with atomic_folder(path) as folder:
            write_pngs(folder, pictures, names)
        return
    write: Callable[[Path, Iterable[Picture], float], None] = _write_mp4 if path.suffix == ".mp4" else _write_animated
    with atomic_path(path) as temporary:
        write(temporary, pictures, fps)


def write_pngs(folder: Path, pictures: Iterable[Picture], names: Sequence[str]) -> None:
    """Write pictures, (H, W) or (H, W, 3) with red first, into a folder under these names, without suffix."""
    for name, picture in zip(names, pictures, strict=True):
        (folder / f"{name}.png").write_bytes(png_of(picture))


def png_of(picture: Picture) -> bytes:
    """Return a picture, (H, W) or (H, W, 3) with red first, as PNG; `OutputError` if OpenCV cannot encode it."""
    encoded, png = cv2.imencode(".png", picture if picture.ndim == 2 else picture[..., ::-1])
    if not encoded:
        raise OutputError(f"OpenCV could not encode a picture of {picture.shape} as PNG")
    return png.tobytes()


def png_with_holes(picture: Picture, unseen: BoolArray) -> bytes:
    """Return a picture as PNG whose pixels are transparent where nothing was seen, (H, W); what is black there becomes 1."""
    if not unseen.any():
        return png_of(picture)
    unseen = unseen if picture.ndim == 2 else unseen[..., None]
    png = png_of(np.where(unseen, 0, np.maximum(picture, 1)).astype(np.uint8))
    return _with_chunk(png, b"tRNS", b"\0\0" * (1 if picture.ndim == 2 else 3))


def advancing(made: Iterable[Picture], advance: Callable[[int], None]) -> Iterator[Picture]:
    """Yield pictures, and call `advance` with 1 when each is written."""
    for picture in made:
        yield picture
        advance(1)


def _write_mp4(path: Path, pictures: Iterable[Picture], fps: float) -> None:
    """Write H.264, whose sides must be even: an odd row or column at the end is doubled."""
    import av

    frames = (
        np.pad(picture, [(0, side % 2) for side in picture.shape[:2]] + [(0, 0)] * (picture.ndim - 2), mode="edge")
        for picture in pictures
    )
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000), options={"crf": _CRF})
        stream.pix_fmt = "yuv420p"
        for number, frame in enumerate(frames):
            if number == 0:
                stream.height, stream.width = height, width = frame.shape[:2]
                if max(height, width) > _MOST_H264_PX:
                    raise OutputError(
                        f"cannot write an MP4 of {height}x{width} px: its sides hold up to {_MOST_H264_PX:,}; make them "
                        "smaller, or write PNGs to a folder"
                    )
            layout = "gray" if frame.ndim == 2 else "rgb24"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format=layout)))
        container.mux(stream.encode())


def _write_animated(path: Path, pictures: Iterable[Picture], fps: float) -> None:
    from PIL import Image

    first, *others = map(Image.fromarray, pictures)
    first.save(path, save_all=True, append_images=others, duration=round(1000 / fps), loop=0, quality=_WEBP_QUALITY)


def photo_sphere(canvas: Canvas, shape: tuple[int, int]) -> str | None:
    """Return the XMP packet of a picture of a canvas, of (height, width); None if it is not spherical.

    The picture may be smaller than the canvas. Where it crosses the back of the sphere, it is turned so that it does not.
    """
    if canvas.projection != "spherical" or canvas.period_px is None:
        return None
    per_pixel = shape[1] / canvas.width
    full = max(round(canvas.period_px * per_pixel), shape[1])
    a, b = (-(0.5 + canvas.transform[axis, 2]) * per_pixel for axis in (0, 1))
    left, top = round(a + full / 2), round(b + full / 4)
    crosses = not 0 <= left <= full - shape[1]
    values = {
        "ProjectionType": "equirectangular",
        "UsePanoramaViewer": "True",
        "FullPanoWidthPixels": full,
        "FullPanoHeightPixels": max(round(full / 2), shape[0]),
        "CroppedAreaImageWidthPixels": shape[1],
        "CroppedAreaImageHeightPixels": shape[0],
        "CroppedAreaLeftPixels": (full - shape[1]) // 2 if crosses else left,
        "CroppedAreaTopPixels": int(np.clip(top, 0, max(round(full / 2) - shape[0], 0))),
    }
    described = "".join(f"<GPano:{name}>{value}</GPano:{name}>" for name, value in values.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/">'
        f"{described}</rdf:Description></rdf:RDF></x:xmpmeta>"
    )


def with_xmp(png: bytes, packet: str) -> bytes:
    """Return a PNG with an XMP packet; its pixels are not encoded again."""
    # Keyword, no compression, no language, no translated keyword.
    return _with_chunk(png, b"iTXt", _KEYWORD + b"\0\0\0\0\0" + packet.encode())


def _with_chunk(png: bytes, name: bytes, content: bytes) -> bytes:
    chunk = name + content
    return png[:_HEADER] + struct.pack(">I", len(content)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + png[_HEADER:]
