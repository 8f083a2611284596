"""The pictures of pages in docs/how-to/read-the-report.md and docs/how-to/compare-runs.md, drawn by Chromium.

python docs/report_pictures.py RUN FAILED COMPARISON   of a run folder, the page of a run that failed, and that of a comparison
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests"))
from browser import Page, browser

IMAGES = Path(__file__).parent / "images"
WIDTH, PHONE = 1100, 400


def main(run: Path, failed: Path, comparison: Path) -> None:
    """Open the pages, and write what is seen of them."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder, browser(Path(folder)) as page:
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


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
