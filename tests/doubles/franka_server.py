"""franka-sim's server whose arm moves in its own time: run where that is.

    python franka_server.py FILE [options of franka_sim.run_server]

FILE keeps where the arm stands, for the next one. At a SIGUSR1 the arm stops with a reflex, as if it had hit something.

As it comes the arm moves in the host's time and is told where to be in its own, which on a busy host is slower: then it
is far behind what it was told. Here it moves by a millisecond for each state that it tells, its servo is stiffer, and
its time stands still until that state was answered: for `PATIENCE` at most, and not where it is to judge that.
"""

import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
from franka_sim import mujoco_franka_sim, run_server
from franka_sim.server.motion_session import MotionSessionMixin

STIFFNESS = [20e3, 20e3, 20e3, 20e3, 10e3, 10e3, 10e3]  # [Nm/rad]
DAMPING = [200.0, 200.0, 200.0, 200.0, 100.0, 100.0, 100.0]  # [Nm s/rad]: twice the armature in 1 ms would swing
IDLE = 0.1  # [s]
PATIENCE = 0.2  # [s] without an answer, after which the arm does without, as a real one after a millisecond

CARTESIAN_REFLEX = 7  # among the errors of the protocol

answered = MotionSessionMixin._drain_gate
watched = MotionSessionMixin._run_safety_velocity_check
free_running = mujoco_franka_sim.MujocoFrankaSim.run_simulation
moving, hit = threading.Lock(), threading.Event()
stands: Any = None


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
            stands[:] = self._state_snapshot["q"]
    return self._state_snapshot


def wait_for_the_answer(self: Any, answer_deadline: float) -> float:
    """Return when the state before was answered; the time [s] that this took."""
    return answered(self, answer_deadline + PATIENCE)


def watch(self: Any, sim_state: Any) -> None:
    """Stop with a reflex when something was hit."""
    if hit.is_set():
        hit.clear()
        self._abort_with_error(CARTESIAN_REFLEX, "something was hit")
    watched(self, sim_state)


if __name__ == "__main__":
    mujoco_franka_sim.ARM_POSITION_KP, mujoco_franka_sim.ARM_POSITION_KD = np.array(STIFFNESS), np.array(DAMPING)
    mujoco_franka_sim.MujocoFrankaSim.run_simulation = run_simulation
    mujoco_franka_sim.MujocoFrankaSim.get_robot_state = get_robot_state
    MotionSessionMixin._run_safety_velocity_check = watch
    file = Path(sys.argv.pop(1))
    stands = np.memmap(file, float, "r+" if file.exists() else "w+", shape=(7,))
    if stands.any():
        mujoco_franka_sim.ARM_INITIAL_Q = np.array(stands)
    if "--enforce-comm-constraints" not in sys.argv:
        MotionSessionMixin._drain_gate = wait_for_the_answer
    signal.signal(signal.SIGUSR1, lambda *_: hit.set())
    run_server.main()
