"""Varied maps of the project's own making, on which the networks that it ships are trained."""

from igaussian_core.procedural.maps import FreeSpace, ProceduralMap
from igaussian_core.procedural.objects import make_object
from igaussian_core.procedural.room import make_room

__all__ = ["FreeSpace", "ProceduralMap", "make_object", "make_room"]
