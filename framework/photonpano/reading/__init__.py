"""What sources share that read captures from files: packed frames, .npy headers, arrays, files in order."""

from photonpano.paths import as_written
from photonpano.protocols import Closing
from photonpano.reading.array_content import Content, frames_are_last, packed_frames_are_last, unpacked_content
from photonpano.reading.arrays import read_array, read_arrays, read_picture
from photonpano.reading.binary_source import BinarySource
from photonpano.reading.channels import Channel, with_channel
from photonpano.reading.files import (
    OpenFiles,
    files_in,
    missing_file,
    natural_order,
    objections,
    read_json,
    read_start,
    reading,
    require_readable,
    require_there,
    size_of,
)
from photonpano.reading.filter_arrays import COLOURS, bayer_array, read_filter_array
from photonpano.reading.first_look import look_first
from photonpano.reading.growing import arrived_frames
from photonpano.reading.gzipped import gzipped_npy_header, is_gzip, unpacked, unpacked_start
from photonpano.reading.npy import NpyHeader, npy_header, require_frames, require_whole
from photonpano.reading.packed_files import FrameFile, PackedFileSource
from photonpano.reading.packed_layout import FrameLayout
from photonpano.reading.pieces import Pieces
from photonpano.reading.pixel_order import OtherOrder, PixelOrder, other_order
from photonpano.reading.remote import library, read_range
from photonpano.reading.sampling import sampled_frames, sampled_spans
from photonpano.reading.single_frame_source import SingleFrameSource

__all__ = [
    "COLOURS",
    "BinarySource",
    "Channel",
    "Closing",
    "Content",
    "FrameFile",
    "FrameLayout",
    "NpyHeader",
    "OpenFiles",
    "OtherOrder",
    "PackedFileSource",
    "Pieces",
    "PixelOrder",
    "SingleFrameSource",
    "arrived_frames",
    "as_written",
    "bayer_array",
    "files_in",
    "frames_are_last",
    "gzipped_npy_header",
    "is_gzip",
    "library",
    "look_first",
    "missing_file",
    "natural_order",
    "npy_header",
    "objections",
    "other_order",
    "packed_frames_are_last",
    "read_array",
    "read_arrays",
    "read_filter_array",
    "read_json",
    "read_picture",
    "read_range",
    "read_start",
    "reading",
    "require_frames",
    "require_readable",
    "require_there",
    "require_whole",
    "sampled_frames",
    "sampled_spans",
    "size_of",
    "unpacked",
    "unpacked_content",
    "unpacked_start",
    "with_channel",
]
