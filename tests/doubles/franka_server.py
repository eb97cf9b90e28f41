"""franka-sim's server with an arm whose clock advances with its state messages; runs in franka-sim's environment.

    python franka_server.py FILE [options of franka_sim.run_server]

FILE stores the joint positions for the next start. SIGUSR1 stops the arm with a reflex, like a collision.

The original arm moves in the host's time but is commanded in its own time, which is slower on a busy host: it falls far
behind its set-points. Here each state message advances the arm by a millisecond, its servo is stiffer, and its clock
waits up to `PATIENCE` for the reply to that message, except with `--enforce-comm-constraints`.
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
DAMPING = [200.0, 200.0, 200.0, 200.0, 100.0, 100.0, 100.0]  # [Nm s/rad]: twice the armature in 1 ms would oscillate
IDLE = 0.1  # [s]
PATIENCE = 0.2  # [s]; a real arm waits a millisecond
CARTESIAN_REFLEX = 7  # error number of the protocol

drain_gate = MotionSessionMixin._drain_gate
check_velocity = MotionSessionMixin._run_safety_velocity_check
run_freely = mujoco_franka_sim.MujocoFrankaSim.run_simulation
moving, hit = threading.Lock(), threading.Event()
positions: Any = None


def run_simulation(self: Any) -> None:
    """Simulate the hand in the host's time; the arm advances in `get_robot_state`."""
    if self.enable_hand:
        run_freely(self)
    while self.running:
        time.sleep(IDLE)


def get_robot_state(self: Any) -> Any:
    """Return the state a millisecond later."""
    if not self.enable_hand:
        with moving:
            self.step()
            positions[:] = self._state_snapshot["q"]
    return self._state_snapshot


def wait_for_reply(self: Any, answer_deadline: float) -> float:
    """Wait for the reply to the last state; return the waiting time [s]."""
    return drain_gate(self, answer_deadline + PATIENCE)


def stop_if_hit(self: Any, sim_state: Any) -> None:
    """Stop with a reflex after SIGUSR1."""
    if hit.is_set():
        hit.clear()
        self._abort_with_error(CARTESIAN_REFLEX, "collision")
    check_velocity(self, sim_state)


if __name__ == "__main__":
    mujoco_franka_sim.ARM_POSITION_KP, mujoco_franka_sim.ARM_POSITION_KD = np.array(STIFFNESS), np.array(DAMPING)
    mujoco_franka_sim.MujocoFrankaSim.run_simulation = run_simulation
    mujoco_franka_sim.MujocoFrankaSim.get_robot_state = get_robot_state
    MotionSessionMixin._run_safety_velocity_check = stop_if_hit
    file = Path(sys.argv.pop(1))
    positions = np.memmap(file, float, "r+" if file.exists() else "w+", shape=(7,))
    if positions.any():
        mujoco_franka_sim.ARM_INITIAL_Q = np.array(positions)
    if "--enforce-comm-constraints" not in sys.argv:
        MotionSessionMixin._drain_gate = wait_for_reply
    signal.signal(signal.SIGUSR1, lambda *_: hit.set())
    run_server.main()
