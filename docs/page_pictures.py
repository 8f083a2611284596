"""The pictures of pages, drawn by Chromium: of a run that follows a capture, of a batch, and of reports.

python docs/page_pictures.py live    a simulated camera writes 800 frames a second
python docs/page_pictures.py batch   seven simulated captures, one of them cut short
python docs/page_pictures.py report RUN FAILED COMPARISON   of a run folder, the page of a run that failed, and of a comparison
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

sys.path += [str(Path(__file__).parents[1] / "tests"), str(Path(__file__).parents[1] / "tests" / "benchmarks")]
from harness import IMAGES, groups, hand_held, simulator

from browser import Page, browser
from photonpano import batch, parse_spec, simulate

RATE_HZ, SHAPE, SHOWN_S = 800, (254, 496), 8
"""The camera, and when the page of the run is drawn: when the picture shows half of the frames of that time, in seconds."""
NAMES, CUT = ("bridge", "castle", "harbour", "market", "mill", "station", "tower"), "mill"
WIDTH, PHONE = 1100, 400


def live(page: Page, folder: Path) -> None:
    """Simulate a capture, follow it while it is written, and draw the page."""
    cube, spec, out = folder / "capture.npy", folder / "spec.yaml", folder / "hand-held.live"
    simulate(parse_spec(hand_held(SHAPE)), cube)
    pipe = {"path": "-", "height": SHAPE[0], "width": SHAPE[1], "frame_rate_hz": RATE_HZ}
    spec.write_text(json.dumps({"version": 1, "source": {"use": "packed-raw", "with": pipe}, "resample": groups(250)}))
    command = [sys.executable, "-m", "photonpano", "run", str(spec), "--follow", "--output", str(out.with_suffix(""))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0) as program:
        assert program.stdin is not None
        while not (out / "live.json").exists():
            time.sleep(0.1)
        camera = threading.Thread(target=write, args=(cube, program.stdin))
        camera.start()
        while json.loads((out / "live.json").read_text())["shown"] < SHOWN_S * RATE_HZ / 2:
            time.sleep(0.05)
        seen = shutil.copytree(out, folder / "seen")
        program.kill()
        camera.join()
    page.open(seen / "live.html", WIDTH, 640)
    page.picture(IMAGES / "as-it-arrives.png")


def write(cube: Path, pipe: IO[bytes]) -> None:
    """Write frames as a camera does: each at its time, until nobody reads."""
    begin = time.monotonic()
    for number, frame in enumerate(np.load(cube, mmap_mode="r")):
        time.sleep(max(0.0, begin + number / RATE_HZ - time.monotonic()))
        try:
            pipe.write(frame.tobytes())
        except OSError:
            return


def batch_summary(page: Page, folder: Path) -> None:
    """Simulate captures, run them, and draw the summary."""
    for number, name in enumerate(NAMES):
        capture = simulator(
            n_frames=1000,
            frame_shape=[128, 256],
            seed=number,
            flux=0.3,
            scene={"kind": "street", "seed": number, "width": 1024, "height": 512},
            path={"kind": "pan", "length_px": 80 + 20 * number, "shake": {"rms_px": 2}},
        )
        simulate(parse_spec(capture), folder / f"{name}.npy")
    cut = folder / f"{CUT}.npy"
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    spec = {"version": 1, "source": {"use": "auto"}, "resample": groups(100), "levels": 2}
    result = batch(spec, [folder / "*.npy"], folder / "monday", jobs=2)
    page.open(result.directory / "summary.html", WIDTH, 1120)
    page.picture(IMAGES / "batch.png")


def reports(page: Page, run: Path, failed: Path, comparison: Path) -> None:
    """Open the pages, and write what is seen of them."""
    report = run / "report.html"
    opened(page, report, WIDTH, 880)
    page.picture(IMAGES / "report.png")
    opened(page, report, WIDTH, 780)
    page.run("document.querySelector('#before-and-after').scrollIntoView()")
    page.picture(IMAGES / "report-compare.png")
    opened(page, report, PHONE, 720)
    page.run("document.querySelector('.levels').scrollIntoView()")
    page.picture(IMAGES / "report-phone.png")
    page.open(failed, WIDTH, 1000)
    page.picture(IMAGES / "report-failed.png")
    page.open(comparison, WIDTH, 1000)
    motion = page.run("document.querySelectorAll('section')[1].getBoundingClientRect().bottom")
    page.open(comparison, WIDTH, int(motion))
    page.picture(IMAGES / "compare.png")


def opened(page: Page, report: Path, width: int, height: int) -> None:
    """Open a report, and wait for its viewer."""
    page.open(report, width, height)
    page.wait_for("document.querySelector('#viewer.live')")
    page.run("new Promise((done) => setTimeout(done, 200))")


def main() -> None:
    """Draw the pages of a kind."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as place, browser(Path(place) / "browser") as page:
        match sys.argv[1:]:
            case ["live"]:
                live(page, Path(place))
            case ["batch"]:
                batch_summary(page, Path(place))
            case ["report", run, failed, comparison]:
                reports(page, Path(run), Path(failed), Path(comparison))
            case _:
                sys.exit(__doc__)


if __name__ == "__main__":
    main()
