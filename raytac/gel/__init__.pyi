from .coat_mesh import CoatMesh as CoatMesh
from .coat_mesh import DeformedCoat as DeformedCoat
from .pyramid import ElasticSurround as ElasticSurround
from .surface import GelSurface as GelSurface
from .surface import PadGrid as PadGrid
from .surface import make_grid as make_grid
from .surface import rest_height as rest_height
from .traction import cell_areas as cell_areas
