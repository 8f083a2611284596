"""photonpano compare."""

from pathlib import Path
from typing import Annotated

import typer


def compare(
    runs: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN...", help="Run folders of one capture, at least two.", show_default=False)
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="PAGE.html", help="The page; one that is there is replaced.")
    ] = Path("compare.html"),
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="TRUTH.npz",
            help="The truth that 'simulate' wrote, for scores; by default the one beside the capture.",
            show_default=False,
        ),
    ] = None,
) -> None:
    """Lay runs of one capture side by side.

    Writes a page with their panoramas, which blink on one canvas, how far their motions differ frame by frame, a table of
    scores, and the settings that differ. The first run is the one that the others are compared with.

    Example: photonpano compare runs/first runs/second --output compare.html
    """
    from photonpano.api.comparison import compare as compare_runs
    from photonpano.cli.tables import columns

    found = compare_runs(runs, output, truth)
    rows = [
        [name, "the motion to compare with" if mean is None else _difference(mean)]
        for name, mean in zip(found.runs, found.mean_difference_px, strict=True)
    ]
    typer.echo(columns(rows))
    typer.echo(f"page  {found.page.resolve()}")


def _difference(mean_px: float) -> str:
    return f"{mean_px:.3g} px from it on average" if mean_px else "the same motion"
