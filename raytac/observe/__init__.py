"""Observations for a learner from sensor frames, batched; Gymnasium is not needed."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
