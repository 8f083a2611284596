"""Download a capture of the paper, with its hot pixels and its filters, for vanvleck.yaml.

    python paper_captures.py [vanvleck | vanvleck2 | cs6floorlounge] [FOLDER]

The captures lie in ZIP archives of a public bucket: 82 and 92 GB are unpacked straight from there. What was written whole
is not written again. Needs `pip install photonpano[s3,http]`. Then run vanvleck.yaml, beside this script, in that folder.
"""

import shutil
import sys
import zipfile
from pathlib import Path

import fsspec
import numpy as np

BUCKET = "s3://public-datasets"
FOLDERS = ("quantavision", "quanta-vision/sequences")  # now, and before September 2026
PUBLIC = {"anon": True, "endpoint_url": "https://web.s3.wisc.edu"}
HOT_PIXELS = "colorSPAD_continuous_stream.npy"  # in the archive of masks
FILTERS = "https://raw.githubusercontent.com/WISION-Lab/photoncube/main/rgbw_oh_bn_color_ss2_corrected.png"


def write(source, target: Path) -> None:
    """Copy a stream to a file, which is there only when it is whole."""
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(target.name + ".part")
    with part.open("wb") as file:
        shutil.copyfileobj(source, file, 2**24)
    part.replace(target)
    sys.stderr.write(f"{target}: {target.stat().st_size:,} bytes\n")


def download(capture: str, folder: Path, bucket: str = BUCKET, filters: str = FILTERS) -> None:
    """Write the files of a capture, its hot pixels and its filters, where vanvleck.yaml expects them."""
    place = folder / "quantavision" / "pano" / capture
    hot, coloured = folder / "masks" / "hot.npy", folder / "masks" / "filters.png"
    wanted = {f"{capture}/binary.npy": place / "binary.npy", f"{capture}/arguments.json": place / "arguments.json"}
    wanted[HOT_PIXELS] = hot.with_name(HOT_PIXELS)
    try:
        files, root = fsspec.url_to_fs(bucket, **(PUBLIC if bucket.startswith("s3:") else {}))
        # The folder holds 2.4 TB: archives of other papers are not opened.
        listed = [path for each in FOLDERS if files.exists(f"{root}/{each}") for path in sorted(files.find(f"{root}/{each}"))]
    except Exception as error:
        sys.exit(f"error: {bucket} cannot be listed: {error}")
    for path in (each for each in listed if "/pano" in each or "mask" in each):
        loose = {name: target for name, target in wanted.items() if path.endswith(name) and not target.exists()}
        for target in loose.values():
            with files.open(path) as source:
                write(source, target)
        if path.endswith(".zip"):
            with files.open(path) as file, zipfile.ZipFile(file) as archive:
                for member in archive.namelist():
                    target = next((each for name, each in wanted.items() if f"/{member}".endswith(f"/{name}")), None)
                    if target is not None and not target.exists():
                        with archive.open(member) as source:
                            write(source, target)
    if missing := [name for name, target in wanted.items() if not target.exists()]:
        sys.exit(
            f"error: {bucket} has no {' and no '.join(missing)}; it may have moved: see https://github.com/WISION-Lab/datasets"
        )
    if not hot.exists():  # true for pixels that are hot, which are few
        found = np.load(wanted[HOT_PIXELS]).astype(bool)
        np.save(hot, ~found if found.mean() > 0.5 else found)
    if not coloured.exists():
        with fsspec.open(filters) as source:
            write(source, coloured)


if __name__ == "__main__":
    chosen, target = [*sys.argv[1:], *("vanvleck", ".")[len(sys.argv) - 1 :]][:2]
    download(chosen, Path(target))
    frames = Path(target) / "quantavision" / "pano" / chosen / "binary.npy"
    sys.stderr.write(f"Next: photonpano info {frames} --with frame_rate_hz=96800\n")
