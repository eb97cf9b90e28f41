"""Write models of the FR3 and its hand without meshes; runs in the environment of franka-sim."""

import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import franka_sim
import mujoco

ARMATURE = [0.2, 0.2, 0.2, 0.2, 0.1, 0.1, 0.1]  # [kg m^2] of the motors, at the joints
FINGER = """<body name="{name}" pos="0 0 0.058" {turned}>
  <inertial pos="0 0 0.03" mass="0.015" diaginertia="2e-6 2e-6 1e-6"/>
  <joint name="{joint}" type="slide" axis="0 1 0" range="0 0.04" armature="0.1"/>
</body>"""
HAND = f"""<mujoco model="hand"><worldbody><body name="hand">
<inertial pos="0 0 0.03" mass="0.7" diaginertia="1e-3 2.5e-3 1.7e-3"/>
{FINGER.format(name="left_finger", turned="", joint="finger_joint1")}
{FINGER.format(name="right_finger", turned='quat="0 0 0 1"', joint="finger_joint2")}
</body></worldbody></mujoco>"""


def main() -> None:
    """Write fr3.xml and hand.xml into the folder given as argument."""
    robot = ET.parse(Path(franka_sim.__file__).parent / "models" / "fr3.urdf").getroot()
    for link in robot.iter("link"):
        for shape in [part for part in link if part.tag in ("visual", "collision")]:
            link.remove(shape)
    compiler = {"fusestatic": "false", "balanceinertia": "true", "boundmass": "1e-4", "boundinertia": "1e-6"}
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler", compiler)
    spec = mujoco.MjSpec.from_string(ET.tostring(robot, encoding="unicode"))
    for joint, armature in zip(spec.joints, ARMATURE, strict=True):
        joint.armature = armature
    spec.compile()
    folder = Path(sys.argv[1])
    (folder / "fr3.xml").write_text(spec.to_xml())
    (folder / "hand.xml").write_text(HAND)


if __name__ == "__main__":
    main()
