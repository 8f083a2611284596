"""Source `ubicept-h5`: the .ubi.h5 files of Ubicept; light enough to be imported when plugins are listed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pydantic import Field

from photonpano import Config, Recognised, Requirement, Source, SourceContext, SourceContribution, SpecPath
from photonpano.reading import read_start

_SUFFIX = ".ubi.h5"
_HDF = b"\x89HDF\r\n\x1a\n"


class UbiceptConfig(Config):
    """A capture in one file, whose frames are sums of binary frames."""

    path: SpecPath = Field(description="the .ubi.h5 file")
    binary_frames: int | None = Field(
        None, ge=1, le=65535, description="binary frames that each frame is the sum of; by default what the file says"
    )
    frame_rate_hz: float | None = Field(
        None, gt=0, description="frames (sums) a second, in Hz; by default what the file says, if it does"
    )


def _build(config: UbiceptConfig, context: SourceContext) -> Source:
    from photonpano_sensors.ubicept_file import UbiceptSource

    del context
    return UbiceptSource(config)


def _check(config: UbiceptConfig) -> Sequence[str]:
    """Look whether it is HDF5; what is in it takes a library."""
    if not config.path.is_file():
        return (f"there is no file {config.path}; check the path",)
    if read_start(config.path, len(_HDF)) != _HDF:
        return (f"{config.path} is not an HDF5 file, by its first bytes; copy it again, or choose another source",)
    return ()


def _recognise(path: Path) -> Recognised | None:
    if not path.name.lower().endswith(_SUFFIX) or _check(UbiceptConfig(path=path)):
        return None
    return Recognised({"path": str(path)}, f"an HDF5 file that is called {_SUFFIX}")


UBICEPT_H5 = SourceContribution(
    name="ubicept-h5",
    summary="Sums of binary frames in the .ubi.h5 files of Ubicept",
    config=UbiceptConfig,
    build=_build,
    check=_check,
    recognise=_recognise,
    suffixes=(".h5",),
    requires=(Requirement("h5py", "photonpano[hdf5]"),),
)
