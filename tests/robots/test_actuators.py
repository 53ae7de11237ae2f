"""Kinds, units, ranges and names of actuators, read from a model with one of each."""

from __future__ import annotations

import math

import mujoco
import pytest

from raytac.robots.actuators import actuators

MODEL = """<mujoco><compiler angle="radian"/><worldbody><body><geom size=".1" mass="1"/>
<joint name="turn" range="-1 2"/><joint name="slide" type="slide"/><body><geom size=".1" mass="1"/><joint name="free_turn" axis="0 1 0"/>
<joint name="bend" axis="1 0 0" range="-0.5 0.5"/></body></body></worldbody>
<tendon><fixed name="both"><joint joint="free_turn" coef="1"/><joint joint="bend" coef="1"/></fixed></tendon>
<actuator><position name="aim" joint="turn" kp="10"/><position joint="slide" kp="10" ctrlrange="-0.01 0.02"/>
<velocity name="speed" joint="turn" kv="1"/><motor joint="free_turn" forcerange="-5 5"/>
<motor joint="free_turn" ctrlrange="-1 1"/>
<motor name="geared" joint="bend" gear="7"/><position name="pull" tendon="both" kp="3"/>
<intvelocity name="creep" joint="slide" kp="4" actrange="-1 1"/>
<general name="arm" tendon="both" gainprm="2" ctrlrange="0 1"/></actuator></mujoco>"""


def test_each_kind_has_its_unit_its_range_and_a_name():
    found = actuators(mujoco.MjModel.from_xml_string(MODEL))
    assert [(one.name, one.kind, one.unit) for one in found] == [
        ("aim", "position", "°"),
        ("slide 1", "position", "mm"),
        ("speed", "velocity", "°/s"),
        ("free_turn 3", "force", "N m"),
        ("free_turn 4", "force", "N m"),
        ("geared", "control", ""),
        ("pull", "position", "°"),
        ("creep", "velocity", "mm/s"),
        ("arm", "control", ""),
    ]
    ranges = {one.name: (one.low, one.high) for one in found if one.is_ranged}
    assert ranges == {
        "aim": (-1.0, 2.0), "slide 1": (-0.01, 0.02), "free_turn 3": (-5.0, 5.0), "free_turn 4": (-1.0, 1.0), "arm": (0.0, 1.0),
    }  # fmt: skip
    assert found[0].factor == pytest.approx(180.0 / math.pi) and found[1].factor == 1e3
    assert all(one.low < one.high for one in found) and [one.index for one in found] == list(range(9))
