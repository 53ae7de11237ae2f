from .options import LARGEST_SIDE as LARGEST_SIDE
from .options import SensorSettings as SensorSettings
from .options import sensor_outputs as sensor_outputs
from .tactile_sensor import TactileSensor as TactileSensor
