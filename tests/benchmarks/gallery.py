"""Run real captures, and say of each what was given and what was found: the table of docs/explanation/gallery.md.

    python tests/benchmarks/gallery.py docs/explanation/gallery.md [--data FOLDER]

Two captures are part of the repository. The others are downloaded into the folder, `runs/gallery/data` by default, unless they
are there, and their checksums are compared.
"""

from __future__ import annotations

import hashlib
import platform
import shutil
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from harness import EXAMPLES, command, record_of, table, write_tables

from photonpano import InputError, LocationError, Plan, load_spec, load_trajectory, open_source, parse_spec, run

SPIKE_ZOO = "https://raw.githubusercontent.com/chenkang455/Spike-Zoo/32e327ccf2f36f10d224368a79b69a65723beb8b/data/"
PYMRAW = "https://raw.githubusercontent.com/ladisk/pyMRAW/04d947a62181a8edd915e9d79106ed2a2d8fada3/data/"
FILES = {
    "uhsr.npz": (SPIKE_ZOO, "6e47eb26f59e40c71a4a0f677b5a48f647d4ff015313380faa0c2471aa651bff"),
    "data.dat": (SPIKE_ZOO, "c03e101bca99803e1a688c80652ca87922bb71ab2e31d7032bc839cb6bd50ee5"),
    "ball_12bit.cihx": (PYMRAW, "959421c4a604a877c8ff4ee81124e83186c2cc2ac8a7a9cce884e357c09e0542"),
    "ball_12bit.mraw": (PYMRAW, "1b49c662ecb9f70359cec6c31864a4e1c7a2929cbcd8150704b2521cdbc86a39"),
}
"""Public files, each with where it is and its SHA-256."""


def fetched(data: Path) -> None:
    """Download the files that are not there, and compare the checksums of all."""
    data.mkdir(parents=True, exist_ok=True)
    for name, (place, sha256) in FILES.items():
        path = data / name
        if not path.exists():
            try:
                with urllib.request.urlopen(place + name) as answer, path.with_suffix(".part").open("wb") as part:
                    shutil.copyfileobj(answer, part)
            except OSError as error:
                raise SystemExit(f"{place}{name} cannot be downloaded: {error}; put the file into {data}") from None
            path.with_suffix(".part").replace(path)
        if (found := hashlib.sha256(path.read_bytes()).hexdigest()) != sha256:
            raise SystemExit(f"{path} has the SHA-256 {found}, and not {sha256}: remove it, and start again")


def spikes_of(archive: Path) -> Path:
    """Write the spikes of an archive as a .dat file of 250x248 px, whose frames are whole bytes."""
    path = archive.with_suffix(".dat")
    with np.load(archive) as arrays:
        path.write_bytes(np.packbits(arrays["spk"][:, :, :248].ravel(), bitorder="little").tobytes())
    return path


def captures(data: Path) -> Iterator[tuple[str, str, Path | Mapping[str, Any]]]:
    """Yield each capture: its name, what was given beside the file, and its spec."""

    def spec(use: str, path: Path, **sections: Any) -> dict[str, Any]:
        settings = {"path": str(path.resolve()), **sections.pop("settings", {})}
        return {"version": 1, "source": {"use": use, "with": settings}, **sections}

    turns = "mask, flat field, constant velocity, homographies"
    yield "mandrill on a fan", turns, EXAMPLES / "pipelines" / "mandrill.yaml"
    yield "USAF 1951 on a fan", turns, EXAMPLES / "pipelines" / "usaf.yaml"
    helicopter = {"frame_shape": [250, 248], "frame_rate_hz": 20_000}
    yield "helicopter, spike camera", "the size of frames", spec("spike-dat", spikes_of(data / "uhsr.npz"), settings=helicopter)
    yield (
        "street, spike camera",
        "the size of frames",
        spec("spike-dat", data / "data.dat", settings={"frame_shape": [250, 400]}),
    )
    yield "nebula, Chandra", "the size of frames", EXAMPLES / "pipelines" / "nebula.yaml"
    yield "falling ball, FASTCAM", "nothing", spec("fastcam-mraw", data / "ball_12bit.cihx")


def row(name: str, given: str, plan: Plan) -> tuple[Sequence[str], str]:
    """Run a capture; return its row, what it is, what was given and what was found, and the reasons of its verdict."""
    with open_source(plan) as source:
        info, counts = source.info, source.counts(source.info.span)[source.valid]
        flux = float(source.response.flux(np.asarray(counts / info.n_frames, np.float32), info.n_frames).mean())
    start = name, f"{info.n_frames} of {info.frame_shape[0]}x{info.frame_shape[1]}", f"{flux:.2g}", given
    try:
        if not (plan.output.directory / "run.json").exists():
            run(plan)
    except (InputError, LocationError) as error:
        return (*start, "error", "", "", ""), str(error).splitlines()[0]
    record, motion = record_of(plan.output.directory), load_trajectory(plan.output.directory)
    verdict = record["verdict"]
    turns = [each["value"] for each in record["decisions"] if each["what"] == "start"]
    middle = np.array([info.frame_shape[1] / 2, info.frame_shape[0] / 2, 1])
    first, last = (at[:2] / at[2] for at in motion.homographies[[0, -1]] @ middle)
    found = turns[0] if turns else f"a shift by {np.hypot(*(last - first)):.1f} px, from the first frame to the last"
    reasons = "; ".join(f"{each['what']} ({each['figure']:.2g})" for each in verdict["reasons"])
    return (*start, verdict["status"], found, f"{np.median(motion.std_px):.2g} px", f"{verdict['reduced_chi2']:.2g}"), reasons


def main(page: Path | None, data: Path | None = None, folder: Path = Path("runs/gallery")) -> None:
    """Run all captures, and write the table."""
    data = data or folder / "data"
    fetched(data)
    rows, reasons = [], []
    for name, given, spec in captures(data):
        directory = folder / name.replace(", ", "-").replace(" ", "-")
        plan = load_spec(spec, output=directory) if isinstance(spec, Path) else parse_spec(spec, output=directory)
        found, why = row(name, given, plan)
        rows.append(found)
        reasons.append(f"- {name}: {why or 'nothing is doubtful'}.")
    head = ("Capture", "Frames", "Photons", "Given", "Verdict", "Motion that was found", "Expected error", "Chi-square")
    line = "python tests/benchmarks/gallery.py docs/explanation/gallery.md"
    made = f"{datetime.now(UTC):%Y-%m-%d}, {platform.machine()}: `{line}`"
    lines = [*table(head, rows), "", made, "", "What the verdicts name, each with its figure:", "", *reasons]
    write_tables(page, {"captures": lines})


if __name__ == "__main__":
    command(main, "captures")
