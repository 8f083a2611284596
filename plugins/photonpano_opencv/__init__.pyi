from .locators import EccLocator as EccLocator
from .locators import OrbLocator as OrbLocator
from .locators import PhaseCorrelationLocator as PhaseCorrelationLocator
from .locators import SiftLocator as SiftLocator
