from .part import Part as Part
from .part import mesh_part as mesh_part
from .part import primitive as primitive
from .underside import object_bounds as object_bounds
from .underside import object_height as object_height
from .underside import object_radius as object_radius
