"""franka-sim's server whose arm moves in its own time: run where that is, with the options of `franka_sim.run_server`.

As it comes the arm moves in the host's time and is told where to be in its own, which on a host that is busy is slower:
then it is far behind what it was told. Here it moves by a millisecond for each state that it tells, with a servo that is
stiffer, and its time stands still until that state was answered: for `PATIENCE` at most, and not where it is to judge that.
"""

import sys
import threading
import time
from typing import Any

import numpy as np
from franka_sim import mujoco_franka_sim, run_server
from franka_sim.server.motion_session import MotionSessionMixin

STIFFNESS = [20e3, 20e3, 20e3, 20e3, 10e3, 10e3, 10e3]  # [Nm/rad]
DAMPING = [200.0, 200.0, 200.0, 200.0, 100.0, 100.0, 100.0]  # [Nm s/rad]: twice the armature in 1 ms would swing
IDLE = 0.1  # [s]
PATIENCE = 0.2  # [s] without an answer, after which the arm does without, as a real one after a millisecond

answered = MotionSessionMixin._drain_gate
free_running = mujoco_franka_sim.MujocoFrankaSim.run_simulation
moving = threading.Lock()


def run_simulation(self: Any) -> None:
    """Leave the arm to who reads its state; with fingers of its own it goes on as it was made."""
    if self.enable_hand:
        free_running(self)
    while self.running:
        time.sleep(IDLE)


def get_robot_state(self: Any) -> Any:
    """The state a millisecond later."""
    if not self.enable_hand:
        with moving:
            self.step()
    return self._state_snapshot


def wait_for_the_answer(self: Any, answer_deadline: float) -> float:
    """Return when the state before was answered; the time [s] that this took."""
    return answered(self, answer_deadline + PATIENCE)


if __name__ == "__main__":
    mujoco_franka_sim.ARM_POSITION_KP, mujoco_franka_sim.ARM_POSITION_KD = np.array(STIFFNESS), np.array(DAMPING)
    mujoco_franka_sim.MujocoFrankaSim.run_simulation = run_simulation
    mujoco_franka_sim.MujocoFrankaSim.get_robot_state = get_robot_state
    if "--enforce-comm-constraints" not in sys.argv:
        MotionSessionMixin._drain_gate = wait_for_the_answer
    run_server.main()
