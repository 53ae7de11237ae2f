"""Observations for a learner from frames of a sensor: spaces, batched arrays, stacks, randomisation. Gymnasium is not needed."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
