"""Invariants of the kinematic world over random action sequences."""

from itertools import combinations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from common.errors import Refused
from tests.common.sim.rig import R, Rig

positions = st.tuples(st.floats(-0.1, 1.1), st.floats(-0.6, 0.6))
near_box = st.tuples(st.floats(0.4, 0.7), st.floats(0.1, 0.4))


class RandomActions(RuleBasedStateMachine):
    @initialize()
    def start(self):
        self.rig = Rig.with_balls((0.40, -0.30), (0.52, -0.30), (0.64, -0.25), (0.40, -0.17), (0.52, -0.17))
        self.count = 5

    @rule(number=st.integers(0, 20), off=st.floats(-0.012, 0.012))
    def grasp(self, number, off):
        resting = [p for label, p in self.rig.balls().values() if label in ("table", "box")]
        if resting:
            position = resting[number % len(resting)]
            self.rig.grasp(position[0] + off, position[1], position[2])

    @rule(position=positions | near_box, height=st.floats(0.02, 0.5), settle=st.booleans())
    def release(self, position, height, settle):
        self.rig.release(*position, height)
        if settle:
            self.rig.settle()

    @rule(op=st.sampled_from(["add", "move", "remove"]), number=st.integers(1, 12), position=positions | near_box)
    def edit(self, op, number, position):
        known = set(self.rig.world.ids)
        try:
            self.rig.edit(op, f"ball_{number}", None if op == "remove" else position)
        except Refused:
            return
        self.count += {"add": 1, "move": 0, "remove": -1}[op]
        assert (f"ball_{number}" in known) == (op != "add")

    @rule()
    def reset(self):
        self.rig.edit("reset")
        self.count = 5

    @rule(seconds=st.floats(0, 0.3))
    def wait(self, seconds):
        self.rig.now += seconds
        self.rig.tick()

    @invariant()
    def balls_are_conserved(self):
        balls = self.rig.balls()
        assert len(self.rig.world.ids) == self.count == len(balls)
        assert sum(label == "held" for label, _ in balls.values()) <= 1

    @invariant()
    def resting_balls_do_not_overlap(self):
        resting = {name: p for name, (label, p) in self.rig.balls().items() if label in ("table", "box")}
        for (a, p), (b, q) in combinations(resting.items(), 2):
            assert np.linalg.norm(p - q) >= 2 * R - 1e-6, (a, p, b, q)

    @invariant()
    def resting_balls_are_supported(self):
        resting = [(label, p) for label, p in self.rig.balls().values() if label in ("table", "box")]
        for label, p in resting:
            outside = max(abs(p[0] - 0.55), abs(p[1] - 0.25)) > 0.08
            assert outside == (label == "table")
            if label == "box" and p[2] > 0.05:
                assert any(np.allclose(p - [0, 0, 2 * R], q) for _, q in resting)


TestRandomActions = RandomActions.TestCase
TestRandomActions.settings = settings(max_examples=20, stateful_step_count=25, deadline=None)
