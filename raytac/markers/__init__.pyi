from .calibration import PUBLISHED as PUBLISHED
from .perturbation import MarkerPerturbation as MarkerPerturbation
from .surface import bind as bind
from .tracker import MARKER_MODELS as MARKER_MODELS
from .tracker import MarkerFrame as MarkerFrame
from .tracker import MarkerTracker as MarkerTracker
