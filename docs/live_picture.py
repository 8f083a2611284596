"""The picture of the page of a run that follows a capture: a simulated camera writes 800 frames a second; drawn by Chromium.

python docs/live_picture.py
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import IO

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from browser import browser
from photonpano import parse_spec, simulate

PICTURE = Path(__file__).parent / "images" / "as-it-arrives.png"
NAME = "hand-held"
RATE_HZ, SHAPE, SHOWN_S = 800, (254, 496), 8
"""The camera, and when the page is drawn, in seconds after the first frame."""
CAPTURE = {
    "scene": {"kind": "street", "width": 2048, "height": 1365},
    "path": {"kind": "random-spline", "length_px": 200, "shake": {"rms_px": 2.0, "frequencies_hz": [25, 120, 400]}},
    "flux": 0.3,
    "n_frames": 10_000,
    "frame_shape": SHAPE,
}
FOLLOWED = {
    "version": 1,
    "source": {"use": "packed-raw", "with": {"path": "-", "height": SHAPE[0], "width": SHAPE[1], "frame_rate_hz": RATE_HZ}},
    "resample": {"with": {"group_size": 250}},
}
WIDTH, HEIGHT = 1100, 640


def main(folder: Path) -> None:
    """Simulate the capture, follow it while it is written, and draw the page."""
    cube, spec = folder / "capture.npy", folder / "spec.yaml"
    simulate(parse_spec({"version": 1, "source": {"use": "simulator", "with": CAPTURE}}), cube)
    spec.write_text(json.dumps(FOLLOWED))
    command = [sys.executable, "-m", "photonpano", "run", str(spec), "--follow", "--output", str(folder / NAME)]
    live = folder / f"{NAME}.live"
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0) as program:
        assert program.stdin is not None
        while not (live / "live.json").exists():
            time.sleep(0.1)
        camera = threading.Thread(target=write, args=(cube, program.stdin))
        camera.start()
        while json.loads((live / "live.json").read_text())["frames"] < SHOWN_S * RATE_HZ:
            time.sleep(0.05)
        seen = shutil.copytree(live, folder / "seen")
        program.kill()
        camera.join()
    with browser(folder / "browser") as page:
        page.open(seen / "live.html", WIDTH, HEIGHT)
        page.picture(PICTURE)
    print(PICTURE)


def write(cube: Path, pipe: IO[bytes]) -> None:
    """Write frames as a camera does: each at its time, until nobody reads."""
    begin = time.monotonic()
    for number, frame in enumerate(np.load(cube, mmap_mode="r")):
        time.sleep(max(0.0, begin + number / RATE_HZ - time.monotonic()))
        try:
            pipe.write(frame.tobytes())
        except OSError:
            return


if __name__ == "__main__":
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as temporary:
        main(Path(temporary))
