"""Photo-sphere metadata (GPano) of a spherical picture, by which viewers open it as a sphere."""

from __future__ import annotations

import struct
import zlib

import numpy as np

from photonpano.geometry import Canvas

# Bytes of a PNG's signature and of its first chunk, IHDR.
_HEADER = 8 + 25
_KEYWORD = b"XML:com.adobe.xmp"


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
    text = _KEYWORD + b"\0\0\0\0\0" + packet.encode()
    chunk = b"iTXt" + text
    return png[:_HEADER] + struct.pack(">I", len(text)) + chunk + struct.pack(">I", zlib.crc32(chunk)) + png[_HEADER:]
