"""Contact: distances, barrier, friction, continuous collision detection, and the exact test of overlap."""

from ipc.contact.collision import Collision

__all__ = ["Collision"]
