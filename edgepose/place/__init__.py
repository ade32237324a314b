"""The place of a wearer in the room: the path of the pelvis, from poses, contacts and velocity."""

from edgepose.place.tracker import Place, PlaceTracker
from edgepose.place.way import Way

__all__ = ["Place", "PlaceTracker", "Way"]
