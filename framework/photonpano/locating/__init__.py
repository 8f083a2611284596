"""Parts of locators: configs, views of an exposure, coarse-to-fine alignment, least-squares fits, and acceptance of a motion.

A name is imported when it is first used, so that hook modules can take configs from here without OpenCV and scipy.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
