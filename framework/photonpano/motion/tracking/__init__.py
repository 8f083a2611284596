"""Track the image from frames alone, before any motion is known: all trackers correlate short sums of frames in binned pixels.

`spans` holds what they share, on the phase correlation of `photonpano.locating`.
"""

from photonpano.motion.tracking.places import Place, Track
from photonpano.motion.tracking.start import StartingMotion, starting_motion

__all__ = ["Place", "StartingMotion", "Track", "starting_motion"]
