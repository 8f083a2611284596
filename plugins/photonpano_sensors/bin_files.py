"""Captures in .bin files: packed frames without a header, one file or a folder of them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pydantic import Field

from photonpano import Arrived, Config, InputError, Location, Recognised, SourceContribution, SpecLocation, Url
from photonpano.reading import FrameFile, FrameLayout, PackedFileSource, files_in, objections, size_of


class BinConfig(Config):
    """A capture in .bin files."""

    path: SpecLocation = Field(
        description="a .bin file, or a folder of them, or the URL of either; nested or not, in natural order (0, 2, 10)"
    )
    frame_rate_hz: float | None = Field(None, gt=0, description="frames a second, in Hz; leave it out if unknown")


def bin_source(
    name: str,
    summary: str,
    config: type[BinConfig],
    layout: FrameLayout,
    recognise: Callable[[Path], Recognised | None],
    footer_bytes: int = 0,
) -> SourceContribution:
    """Return the contribution of a source of .bin files; `footer_bytes` may follow the frames of a file."""

    def opened(config: BinConfig) -> PackedFileSource:
        return PackedFileSource(frame_files(config.path, layout, footer_bytes), layout, config.frame_rate_hz)

    def arrived(config: BinConfig) -> Arrived:
        """Open the frames that are there of a capture that is still being written: files appear, and the last one grows."""
        path = config.path
        if isinstance(path, Url):
            raise InputError(f"{path} is a URL, which cannot be followed: follow a folder, or a pipe")
        if not path.exists() or (path.is_dir() and not sizes_of(path)):
            return Arrived(None)
        files = frame_files(path, layout, footer_bytes, growing=True)
        return Arrived(PackedFileSource(files, layout, config.frame_rate_hz) if files else None)

    return SourceContribution(
        name=name,
        summary=summary,
        config=config,
        build=lambda config, _: opened(config),
        check=lambda config: objections(frame_files, config.path, layout, footer_bytes),
        recognise=recognise,
        arrived=arrived,
        suffixes=(".bin",),
    )


def frame_files(path: Location, layout: FrameLayout, footer_bytes: int = 0, *, growing: bool = False) -> list[FrameFile]:
    """Return the files of a capture with the number of frames that follows from their sizes.

    If it is `growing`, the last file counts with its whole frames. Raises an `InputError` if there is no file, a size is not a
    whole number of frames, or a file is larger than the first, or smaller and not the last: frames are missing, or the order is
    wrong.
    """
    files = files_in(path, ".bin")
    sizes = [size_of(file) for file in files]
    found = []
    for file, size in zip(files, sizes, strict=True):
        n_frames, rest = divmod(size, layout.stored_bytes)
        if growing and file is files[-1]:
            found += [FrameFile(file, n_frames)] if n_frames else []
            continue
        if not n_frames or rest not in (0, footer_bytes):
            allowed = f", with or without {footer_bytes} more" if footer_bytes else ""
            raise InputError(
                f"{file} has {size:,} bytes, which is not a whole number of frames of {layout.stored_bytes:,} bytes{allowed}; "
                "it is cut short, or of another camera: copy it again, or choose another source"
            )
        found.append(FrameFile(file, n_frames))
    for each in found[1:]:
        if each.n_frames > found[0].n_frames or (each.n_frames < found[0].n_frames and each is not found[-1]):
            raise InputError(
                f"{each.path} holds {each.n_frames:,} frames and {found[0].path.name}, the first, {found[0].n_frames:,}; only "
                "the last file of a capture may hold fewer: copy it again, or take out the files of other captures"
            )
    return found


def sizes_of(path: Location) -> list[int]:
    """Return the sizes in bytes of the .bin files at a path, in order; an empty list if there are none."""
    try:
        files = files_in(path, ".bin")
        return [size_of(file) for file in files if file.suffix.lower() == ".bin"]
    except (InputError, OSError):
        return []
