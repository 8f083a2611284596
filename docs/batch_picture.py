"""The picture of the summary of a batch: seven simulated captures, one of them cut short, drawn by Chromium.

python docs/batch_picture.py [FOLDER]
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from photonpano import batch, parse_spec, simulate

PICTURE = Path(__file__).parent / "images" / "batch.png"
NAMES = ("bridge", "castle", "harbour", "market", "mill", "station", "tower")
CUT = "mill"
SPEC = {"version": 1, "source": {"use": "auto"}, "resample": {"with": {"group_size": 100}}, "levels": 2}
SIZE = "1100,1120"


def main(folder: Path) -> None:
    """Simulate the captures, run them, and draw the summary."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        sys.exit("the picture needs Chromium or Chrome")
    captures = folder / "captures"
    captures.mkdir()
    for number, name in enumerate(NAMES):
        simulator = {
            "n_frames": 1000,
            "frame_shape": [128, 256],
            "seed": number,
            "flux": 0.3,
            "scene": {"kind": "street", "seed": number, "width": 1024, "height": 512},
            "path": {"kind": "pan", "length_px": 80 + 20 * number, "shake": {"rms_px": 2}},
        }
        simulate(parse_spec({"version": 1, "source": {"use": "simulator", "with": simulator}}), captures / f"{name}.npy")
    cut = captures / f"{CUT}.npy"
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    result = batch(SPEC, [captures / "*.npy"], folder / "monday", jobs=2)
    page = (result.directory / "summary.html").as_uri()
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--window-size={SIZE}"]
    subprocess.run([browser, *options, f"--screenshot={PICTURE}", page], check=True)
    print(PICTURE)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        Path(sys.argv[1]).mkdir(parents=True)
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(Path(temporary))
