"""Find out whether the light of a capture changes, and measure it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from photonpano.context import Context
from photonpano.geometry import corner_displacements, inverse
from photonpano.lighting.flicker import LocalFlicker, local_frequency, measure_local_flicker
from photonpano.lighting.gains import Gains, seen_cells, solve_gains
from photonpano.lighting.series import gain_of_frames
from photonpano.protocols import Source, Trajectory
from photonpano.values import Decision, FloatArray, FrameSpan, Homography, Light

LIGHT_DECISION = "light"  # what a record names the decision to divide by the gain of the light
# Least root mean square of changes of the light, between instants that see the same places, that are divided out.
LEAST_CHANGE = 0.03
_LEAST_SIGMAS = 3.0  # least ratio of these changes to their noise
_PROBES, _PROBE_FRAMES = 128, 16  # spans all over the capture, and frames of each, that are compared to find out
_MOST_SPANS, _FEWEST_FRAMES = 640, 4  # most spans, and fewest frames of each, with which the light is measured
_SPAN_PX = 4.0  # the image moves by no more than this in a span


def find_light(source: Source, trajectory: Trajectory, context: Context) -> Light | None:
    """Measure the light of a capture along its motion, known to a few pixels; None if it is steady."""
    n_frames = source.info.n_frames
    longest = max(1, min(_PROBE_FRAMES, int(_SPAN_PX / max(speed_px(source, trajectory), 1e-9)), n_frames // _PROBES))
    gains = _gains(source, trajectory, _spread(n_frames, longest), context)
    return measure_light(source, trajectory, context) if changes(gains) or local_frequency(gains) else None


def changes(gains: Gains) -> bool:
    """Return whether the changes of the light exceed those of steady light, and noise."""
    return gains.change > max(LEAST_CHANGE, _LEAST_SIGMAS * float(np.median(gains.std)))


def measure_light(source: Source, trajectory: Trajectory, context: Context) -> Light:
    """Measure the gain of each frame of a capture along its motion, known to a few pixels."""
    n_frames = source.info.n_frames
    length = min(n_frames, max(_FEWEST_FRAMES, -(-n_frames // _MOST_SPANS)))
    bounds = np.linspace(0, n_frames, max(1, n_frames // length) + 1).astype(int).tolist()
    gains = _gains(source, trajectory, [FrameSpan(*pair) for pair in pairwise(bounds)], context)
    frequency = local_frequency(gains)
    if frequency and gains.seen.to_cells is not None:
        return _light_of(measure_local_flicker(gains, frequency), gains.seen.to_cells, gains, n_frames)
    lengths = np.array([len(span) for span in gains.seen.spans], float)
    gain, std, frequency = gain_of_frames(gains.seen.instants, gains.gain, gains.std, lengths, n_frames)
    mean = float(gain.mean())
    return Light.of_frames(gain / mean, frequency, std / mean)


def corrected_light(light: Light, spans: Sequence[FrameSpan], change: FloatArray, std: FloatArray) -> Light:
    """Correct light by what the panorama rendered in it does not explain.

    Squares of the scene are brighter and darker inside, so that a sensor that saturates sees too little of their changes; a
    panorama has every pixel. Lamps over parts of the scene stay as they are.

    Args:
        light: in which the panorama was rendered.
        spans: S spans of frames.
        change: (S,) their brightness relative to that of the panorama in this light, minus 1.
        std: (S,) its standard deviation.
    """
    if light.has_lamps:
        return light
    instants = np.array([span.centre for span in spans])
    lengths = np.array([len(span) for span in spans], float)
    gain = np.array([light.mean(span) for span in spans]) * np.maximum(1 + change, 0)
    found, noise, frequency = gain_of_frames(instants, gain, std, lengths, len(light.gain))
    if bool(frequency) != bool(light.frequency):
        return light
    mean = float(found.mean())
    return Light.of_frames(found / mean, frequency, noise / mean)


def _light_of(flicker: LocalFlicker, to_map: Homography, gains: Gains, n_frames: int) -> Light:
    """Return the light of each frame, which flickers differently at each place."""
    frames = np.arange(n_frames)
    slow, std = (np.interp(frames, gains.seen.instants, each) for each in (flicker.slow, gains.std))
    phase = 2 * np.pi * flicker.frequency * frames
    maps = np.stack([flicker.cosine, flicker.sine])
    return Light(slow / slow.mean(), np.stack([np.cos(phase), np.sin(phase)]), maps, to_map, flicker.frequency, std)


def decision_of(light: Light, frame_rate_hz: float | None) -> Decision:
    """Return what was found, for the record: the depth of the changes, and the frequency of a flicker."""
    low, high = (float(np.quantile(light.gain, each)) for each in (0.01, 0.99))
    depth = (high - low) / (high + low)
    where = f"the light of the scene changes between {low:.2f} and {high:.2f} of its mean"
    if light.has_lamps:
        depth = float(np.quantile(np.hypot(*light.maps), 0.9))
        where = f"lamps over parts of the scene, each at its own phase, flicker by up to {depth:.2f} of the mean light"
    if light.frequency:
        period = f"with a period of {1 / light.frequency:.4g} frames"
        where += f", {period}" if frame_rate_hz is None else f", at {light.frequency * frame_rate_hz:.2f} Hz"
    return Decision(LIGHT_DECISION, round(depth, 3), where)


def _gains(source: Source, trajectory: Trajectory, spans: list[FrameSpan], context: Context) -> Gains:
    return solve_gains(seen_cells(source, trajectory, spans, context))


def _spread(n_frames: int, length: int) -> list[FrameSpan]:
    """Return spans all over the capture, at uneven distances, so that no flicker has their period."""
    even = np.linspace(0, n_frames - length, min(_PROBES, n_frames // length))
    jitter = np.random.default_rng(0).uniform(-0.3, 0.3, len(even)) * max(n_frames / _PROBES - length, 0)
    starts = np.clip(even + jitter, 0, n_frames - length).astype(int)
    return [FrameSpan(start, start + length) for start in np.unique(starts).tolist()]


def speed_px(source: Source, trajectory: Trajectory) -> float:
    """Return the usual speed of the image, in px per frame."""
    instants = np.linspace(0, source.info.n_frames - 1, 65)
    steps = inverse(trajectory.at(instants[:-1])) @ trajectory.at(instants[1:])
    moved = np.median(corner_displacements(steps, np.eye(3), source.info.frame_shape).max(axis=-1))
    return float(moved) / max(float(instants[1]), 1e-9)
