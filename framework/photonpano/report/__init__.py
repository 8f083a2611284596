"""The HTML reports of runs and of batches: pages that need nothing else.

A name is imported when it is first used: the summary of a batch needs no library of the pipeline.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
