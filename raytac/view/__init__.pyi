from .press_session import PressSession as PressSession
from .recording import StatesSession as StatesSession
from .recording import read_recording as read_recording
from .session import SessionMenu as SessionMenu
from .viewer import Viewer as Viewer
from .world_session import WorldSession as WorldSession
