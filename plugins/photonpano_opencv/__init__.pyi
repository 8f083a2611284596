from .brightness import EccLocator as EccLocator
from .brightness import PhaseCorrelationLocator as PhaseCorrelationLocator
from .keypoints import OrbLocator as OrbLocator
from .keypoints import SiftLocator as SiftLocator
