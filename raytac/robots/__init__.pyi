from .arm import Arm as Arm
from .ik import DifferentialIk as DifferentialIk
from .impedance import CartesianImpedance as CartesianImpedance
from .impedance import JointImpedance as JointImpedance
from .panda import MAX_VELOCITY as MAX_VELOCITY
from .panda import READY as READY
from .panda import one_sensor_panda as one_sensor_panda
