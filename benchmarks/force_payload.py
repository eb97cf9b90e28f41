"""Identification of payloads in a complete cell with physics, with an ideal and with a poor force sensor.

    python -m benchmarks.force_payload [--poses N] [--sensors ideal,poor] [--seed N]

The Panda cell on the virtual clock, `world.simulator: mujoco`, with weights at its hand that are unknown to the cell
(`robot.gripper.payload: {mass: 0}`): what `zencell robot identify-payload` does there, compared with the masses
of the description. The poor sensor has a bias of 3 N and 0.3 N m (standard deviation, one draw per run), white noise of
1 N and 0.05 N m in each reading of 10 ms, and an error of 0.1 N and 5 mN m that is new in each pose: every half second.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from common.client.cell import Cell
from common.config import load_cell
from common.robot.model import RobotModel
from common.robot.tool_mass import described_tool
from drivers.mujoco.arm import PhysicsArm
from tests.client.simulated_cell import run
from tools.payload.least_squares import Identified
from tools.payload.measurement import identify_payload

WEIGHTS = (  # mass [kg], centre of mass from the hand [m]
    (0.0, (0.0, 0.0, 0.0)), (0.2, (0.0, 0.0, 0.05)), (0.5, (0.03, 0.0, 0.06)), (0.8, (-0.02, 0.05, 0.08)),
    (1.2, (0.0, -0.06, 0.10)), (1.6, (0.05, 0.05, 0.04)), (2.2, (0.0, 0.0, 0.12)),
)
BIAS = np.array([3.0, 3.0, 3.0, 0.3, 0.3, 0.3])
NOISE = np.array([1.0, 1.0, 1.0, 0.05, 0.05, 0.05])
DRIFT = np.array([0.1, 0.1, 0.1, 5e-3, 5e-3, 5e-3])
READINGS = 50  # between two values of the drift
URDF = """<robot name="weight"><link name="weight"><inertial><mass value="{mass}"/><origin xyz="{x} {y} {z}"/>
<inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def identified(overrides: list[str], poses: int, seed: int | None) -> Identified:
    """Return what the tool finds in a cell; with a seed the sensor is poor."""
    rng = np.random.default_rng(seed)
    bias, drift, count = BIAS * rng.normal(size=6), np.zeros(6), 0
    ideal, results = PhysicsArm.wrench, list[Identified]()

    def poor(arm: PhysicsArm) -> NDArray[np.float64] | None:
        nonlocal drift, count
        raw = ideal(arm)
        if count % READINGS == 0:
            drift = DRIFT * rng.normal(size=6)
        count += 1
        return None if raw is None else raw + bias + drift + NOISE * rng.normal(size=6)

    async def program(cell: Cell) -> None:
        results.append((await identify_payload(cell, poses=poses, speed=0.5))[0])

    with patch.object(PhysicsArm, "wrench", ideal if seed is None else poor):
        run(program, "panda", *overrides)
    return results[0]


def main() -> None:
    """Run all weights with each sensor."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=6)
    parser.add_argument("--sensors", default="ideal,poor")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    print("sensor  true mass [kg]  com [mm]                found [kg]       error   com error [mm]  relative")
    worst = dict.fromkeys(args.sensors.split(","), (0.0, 0.0))
    with tempfile.TemporaryDirectory() as folder:
        for sensor in worst:
            for number, (mass, at) in enumerate(WEIGHTS):
                overrides = ["world.simulator=mujoco", "world.count=0", "robot.gripper.payload={mass: 0}"]
                if mass:
                    path = Path(folder) / f"weight_{number}.urdf"
                    path.write_text(URDF.format(mass=mass, x=at[0], y=at[1], z=at[2]))
                    overrides.append(f"robot.attachments=[{{urdf: {path}, parent_link: panda_hand}}]")
                true = described_tool(RobotModel.load(load_cell("panda", overrides).robot))
                assert true is not None
                found = identified(overrides, args.poses, args.seed + number if sensor == "poor" else None)
                mass_error = abs(found.mass / true[0] - 1)
                com_error = float(np.linalg.norm(found.com - true[1]))
                relative = com_error / float(np.linalg.norm(true[1]))
                worst[sensor] = max(worst[sensor][0], mass_error), max(worst[sensor][1], relative)
                print(f"{sensor:6}  {true[0]:14.3f}  {np.array2string(1e3 * true[1], precision=1):22}  "
                      f"{found.mass:.3f} +- {found.mass_error:.3f}  {mass_error:6.2%}  "
                      f"{1e3 * com_error:6.2f} +- {1e3 * found.com_error:.2f}  {relative:8.2%}", flush=True)
    for sensor, (mass_error, com_error) in worst.items():
        print(f"{sensor}: largest error of {len(WEIGHTS)}: mass {mass_error:.2%}, centre of mass {com_error:.2%}")


if __name__ == "__main__":
    main()
