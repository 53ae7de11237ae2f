from .presses import read_presses as read_presses
