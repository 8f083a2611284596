from .locators import FeatureLocator as FeatureLocator
from .locators import LoftrLocator as LoftrLocator
from .locators import RegistratorLocator as RegistratorLocator
