"""Contact: distances, barrier, friction, continuous collision detection, overlap."""

from ipc.contact.collision import Collision

__all__ = ["Collision"]
