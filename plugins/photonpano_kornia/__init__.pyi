from .matched import FeatureLocator as FeatureLocator
from .matched import LoftrLocator as LoftrLocator
from .registrator import RegistratorLocator as RegistratorLocator
