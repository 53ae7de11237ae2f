from .press_session import PressSession as PressSession
from .viewer import Viewer as Viewer
