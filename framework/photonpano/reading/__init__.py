"""What sources share that read captures from files: packed frames, .npy headers, files in order."""

from photonpano.reading.binary_source import BinarySource
from photonpano.reading.files import OpenFiles, files_in, read_json, read_start
from photonpano.reading.gzipped import gzipped_npy_header, is_gzip, unpacked, unpacked_start
from photonpano.reading.npy import NpyHeader, npy_header, require_whole
from photonpano.reading.objections import objections
from photonpano.reading.packed_files import FrameFile, PackedFileSource
from photonpano.reading.packed_layout import FrameLayout

__all__ = [
    "BinarySource",
    "FrameFile",
    "FrameLayout",
    "NpyHeader",
    "OpenFiles",
    "PackedFileSource",
    "files_in",
    "gzipped_npy_header",
    "is_gzip",
    "npy_header",
    "objections",
    "read_json",
    "read_start",
    "require_whole",
    "unpacked",
    "unpacked_start",
]
