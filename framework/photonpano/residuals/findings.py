"""What a run finds of its capture and its motion. Decisions, verdict and record are rendered from it."""

from __future__ import annotations

from dataclasses import dataclass, replace

from photonpano.motion.level import Timeline
from photonpano.text import listed, pixels
from photonpano.values import Decision, FrameSpan

_MOST_LISTED = 8  # spans without light that are named one by one


@dataclass(frozen=True, slots=True)
class Jump:
    """A place where the image seems to jump from one frame to the next."""

    frame: int  # the first frame after it
    size_px: float
    sigmas: float  # its size in standard deviations of what the image does nearby
    dark: FrameSpan | None = None  # frames around it that show nothing; None where all have light

    @property
    def decision(self) -> Decision:
        """The cut of the motion there, for the record."""
        jump = f"the image jumps by {pixels(self.size_px)} px ({self.sigmas:.0f} standard deviations)"
        if self.dark is not None:
            reason = f"{jump} while they show nothing; the interpolation is cut in the middle, at frame {self.frame}"
            return Decision("jump_in_the_dark", str(self.dark), reason)
        reason = f"{jump} from the frame before to this one, as where frames are missing or doubled"
        return Decision("cut", self.frame, f"{reason}; the interpolation is cut there")


@dataclass(frozen=True, slots=True)
class Doubt:
    """A distance to another motion that is as possible as the one that was found."""

    px: float
    where: str  # between what it is measured, a clause


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What a run finds beside its motion and its panorama."""

    standing_share: float = 0.0  # of the frame that stands still, of the parts that show motion or rest
    start: Decision | None = None  # the constant velocity or smooth path from which the first level starts
    gyroscope: Decision | None = None  # how the gyroscope was fitted to the capture
    repeated: int = 0  # frames that are copies of the one before
    dark: tuple[FrameSpan, ...] = ()  # frames without light, which are left out
    shots: tuple[FrameSpan, ...] = ()  # parts that no motion ties together; the longest is located
    cuts: tuple[Jump, ...] = ()  # where the motion is cut
    uncut_jump: Doubt | None = None  # the largest of the jumps where the photons contradict a cut
    rival_motion: Doubt | None = None  # that of a part of the frame
    light_changes: bool = False  # so that the gain of each frame is divided out
    hidden_share: float | None = None  # of the frames that do not show the background; None where nothing was found to hide it
    never_seen_share: float = 0.0  # of the panorama whose background no frame showed
    left_out: tuple[str, ...] = ()  # what the time limit of the run left out

    def along(self, timeline: Timeline) -> Findings:
        """Return these findings with those of a timeline."""
        cuts = tuple(Jump(each.frame, each.size_px, each.sigmas, each.dark) for each in timeline.cuts)
        dark = tuple(sorted(timeline.dark + timeline.unlit, key=lambda span: span.start))
        return replace(self, repeated=timeline.n_repeated, dark=dark, shots=timeline.shots, cuts=cuts)

    @property
    def started(self) -> list[Decision]:
        """What the first level starts with, for the record."""
        return [each for each in (self.start, self.gyroscope) if each is not None]

    @property
    def of_frames(self) -> list[Decision]:
        """What is known of missing, repeated and dark frames, for the record."""
        found = [Decision("repeated_frames", self.repeated, "copies of the frame before; the motion stands still there")]
        dark = [Decision("dark_frames", each, "no light reaches the sensor; these frames are left out") for each in self._dark]
        longest = max(self.shots, key=len, default=None)
        apart = f"no motion ties them together; {longest} are located, since they are the most"
        shots = [Decision("shots", listed(map(str, self.shots)), apart)] if self.shots else []
        return (found if self.repeated else []) + shots + dark + [cut.decision for cut in self.cuts]

    @property
    def _dark(self) -> list[str]:
        """The spans of frames without light, or how many frames in how many of them, where a lamp flashes."""
        if len(self.dark) <= _MOST_LISTED:
            return [str(span) for span in self.dark]
        n_frames = sum(len(span) for span in self.dark)
        return [f"{n_frames:,} frames in {len(self.dark):,} spans, the first {self.dark[0]}"]


NOTHING = Findings()
