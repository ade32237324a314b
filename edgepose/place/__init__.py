"""The place of a wearer in the room: the path of the pelvis, from poses, contacts and velocity."""

from edgepose.place.distance import DistanceWalked
from edgepose.place.tracker import Place, PlaceTracker

__all__ = ["DistanceWalked", "Place", "PlaceTracker"]
