"""What sources share that read captures from files: packed frames, .npy headers, arrays, files in order."""

from photonpano.reading.arrays import read_array, read_arrays, read_picture
from photonpano.reading.binary_source import BinarySource
from photonpano.reading.files import (
    OpenFiles,
    files_in,
    missing_file,
    natural_order,
    objections,
    read_json,
    read_start,
    reading,
)
from photonpano.reading.gzipped import gzipped_npy_header, is_gzip, unpacked, unpacked_start
from photonpano.reading.npy import NpyHeader, npy_header, require_frames, require_whole
from photonpano.reading.packed_files import FrameFile, PackedFileSource
from photonpano.reading.packed_layout import FrameLayout
from photonpano.source_wrapper import Closing

__all__ = [
    "BinarySource",
    "Closing",
    "FrameFile",
    "FrameLayout",
    "NpyHeader",
    "OpenFiles",
    "PackedFileSource",
    "files_in",
    "gzipped_npy_header",
    "is_gzip",
    "missing_file",
    "natural_order",
    "npy_header",
    "objections",
    "read_array",
    "read_arrays",
    "read_json",
    "read_picture",
    "read_start",
    "reading",
    "require_frames",
    "require_whole",
    "unpacked",
    "unpacked_start",
]
