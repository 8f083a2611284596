from .locator import DirectLocator as DirectLocator
