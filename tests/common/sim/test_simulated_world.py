import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from applications.pick_place.topics import scene_balls
from common.config import Fixture, World
from common.errors import ConfigError, Refused
from common.messages import Header, Vector3, WorldEdit
from common.robot.transforms import tool_down
from common.sim import edits
from common.sim.kinematic import KinematicWorld

R = 0.03
OPEN, GRIP = 0.08, 2 * R
TABLE = Fixture(id="table", dimensions=[1.0, 1.0, 0.05], position=(0.5, 0.0, -0.025))
BOX = (0.55, 0.25)


class Rig:
    """A world and a hand in it, with a clock that is moved by hand."""

    def __init__(self, balls=((0.5, 0.0),), **config):
        self.config = World(fixtures=[TABLE], balls=list(balls), **config)
        self.world = KinematicWorld(self.config)
        self.now = 100.0
        self.hand = tool_down(0.5, 0.0, 0.3)
        self.width = OPEN

    def tick(self, hand=None, width=None, gripping=False):
        """What Executor does with simulated fingers."""
        self.now += 0.01
        self.hand = self.hand if hand is None else hand
        obstruction = self.world.obstruction(self.hand, self.width)
        target = self.width if width is None else width
        self.width = max(target, obstruction)
        self.world.tick(self.now, self.hand, self.width, obstruction > target)

    def grasp(self, x, y, z=R, yaw=0.0):
        self.tick(tool_down(x, y, z, yaw), OPEN)
        for width in np.linspace(OPEN, 0.0, 9):
            self.tick(width=width)
        return self.world.held

    def release(self, x, y, z=0.2):
        self.tick(tool_down(x, y, z), 0.0)
        self.tick(width=OPEN)

    def settle(self):
        for _ in range(100):
            self.tick()

    def put_down(self, x, y, z=0.2):
        self.release(x, y, z)
        self.settle()

    def edit(self, op, id="", at=None):  # noqa: A002
        position = Vector3(x=at[0], y=at[1]) if at else None
        return self.world.edit(WorldEdit(op=op, id=id, position=position), self.now)

    def where(self):
        balls = scene_balls(self.world.objects(Header()))
        return {i: (label, np.array([p.position.x, p.position.y, p.position.z]))
                for i, label, p in zip(balls.ids, balls.labels, balls.poses, strict=True)}

    def count(self, label):
        return sum(1 for found, _ in self.where().values() if found == label)

    def events(self):
        return [update.data for update in self.world.take_events()]


# --- grasping ---


def test_balls_rest_on_the_table_with_ids_in_order():
    where = Rig([(0.5, 0.0), (0.6, 0.1)]).where()
    assert list(where) == ["ball_1", "ball_2"]
    assert where["ball_2"][0] == "table" and np.allclose(where["ball_2"][1], [0.6, 0.1, R])


@given(
    yaw=st.floats(-math.pi, math.pi), across=st.floats(-0.0099, 0.0099), sideways=st.floats(-0.0119, 0.0119),
    above=st.floats(-0.0099, 0.0099),
)
def test_ball_between_the_fingers_is_grasped_and_centred_between_them(yaw, across, sideways, above):
    rig = Rig()
    # Tool x and y axes at this yaw, with the tool pointing down.
    hand = tool_down(0.5, 0.0, R + above, yaw)
    x, y, z = hand[:3, 3] + hand[:3, :3] @ [across, sideways, 0.0]
    assert rig.grasp(x, y, z, yaw) == "ball_1"
    assert rig.width == GRIP
    offset = rig.hand[:3, :3].T @ (rig.where()["ball_1"][1] - rig.hand[:3, 3])
    assert offset[1] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("off", [(0.011, 0, 0), (0, 0.013, 0), (0, 0, 0.011), (0, 0.05, 0), (0.2, 0, 0)])
def test_fingers_beside_the_ball_close_on_air(off):
    rig = Rig()
    assert rig.grasp(0.5 + off[0], 0.0 + off[1], R + off[2]) == ""
    assert rig.width == 0.0 and rig.where()["ball_1"][0] == "table" and rig.events() == []


def test_hand_that_comes_down_with_closed_fingers_grasps_nothing():
    rig = Rig()
    rig.tick(width=0.03)
    rig.tick(tool_down(0.5, 0.0, R))
    rig.tick(width=0.0)
    assert rig.world.held == "" and rig.width == 0.0


def test_only_one_ball_is_grasped():
    rig = Rig([(0.5, 0.0), (0.56, 0.0)])
    assert rig.grasp(0.5, 0.0) == "ball_1"
    assert [label for label, _ in rig.where().values()] == ["held", "table"]


def test_held_ball_moves_rigidly_with_the_hand():
    rig = Rig()
    rig.grasp(0.502, 0.0, 0.035)
    grip = rig.hand[:3, :3].T @ (rig.where()["ball_1"][1] - rig.hand[:3, 3])
    turned = tool_down(0.3, 0.2, 0.4, 1.0)
    rig.tick(turned)
    assert np.allclose(rig.where()["ball_1"][1], turned[:3, :3] @ grip + turned[:3, 3])


def test_grasp_and_rest_are_told_in_the_words_of_the_seed():
    rig = Rig()
    rig.grasp(0.5, 0.0)
    assert rig.events() == ["remove:ball_1"]
    rig.release(0.3, 0.0)
    assert rig.events() == []
    rig.settle()
    (update,) = rig.world.take_events()
    assert update.data == "add:ball_1" and update.pose.position.x == pytest.approx(0.3)


# --- letting go ---


def test_ball_falls_as_gravity_says_and_lies_where_it_was_let_go():
    rig = Rig()
    rig.grasp(0.5, 0.0)
    rig.release(0.3, -0.1, 0.5)
    rig.tick()
    assert rig.where()["ball_1"][0] == "falling"
    begin, height = rig.now, rig.where()["ball_1"][1][2]
    while rig.where()["ball_1"][0] == "falling":
        rig.tick()
    assert rig.now - begin <= math.sqrt(2 * (height - R) / 9.81) + 0.011
    assert rig.where()["ball_1"][0] == "table" and np.allclose(rig.where()["ball_1"][1], [0.3, -0.1, R])


def test_fingers_must_open_beyond_the_ball_to_let_go():
    rig = Rig()
    rig.grasp(0.5, 0.0)
    rig.tick(width=GRIP + 0.001)
    assert rig.world.held == "ball_1"
    rig.tick(width=GRIP + 0.003)
    assert rig.world.held == ""


def test_long_tick_lands_the_ball():
    rig = Rig()
    rig.grasp(0.5, 0.0)
    rig.release(0.3, 0.0)
    rig.now += 100
    rig.tick()
    assert rig.where()["ball_1"][0] == "table"


def test_eight_balls_fill_the_box_in_two_layers_and_the_ninth_lies_beside_it():
    spots = [(0.3 + 0.07 * i, -0.3 + 0.07 * j) for i in range(3) for j in range(3)]
    rig = Rig(spots)
    for x, y in spots:
        assert rig.grasp(x, y)
        rig.put_down(*BOX)
    where = rig.where()
    inside = [position for label, position in where.values() if label == "box"]
    assert len(inside) == 8 and len({tuple(np.round(p, 6)) for p in inside}) == 8
    assert sorted(round(float(p[2]), 3) for p in inside) == [0.035] * 4 + [0.095] * 4
    label, ninth = where["ball_9"]
    assert label == "table" and max(abs(ninth[0] - 0.55), abs(ninth[1] - 0.25)) >= 0.08 + R - 1e-9


def test_ball_in_the_box_takes_the_slot_below_it():
    rig = Rig()
    rig.grasp(0.5, 0.0)
    rig.put_down(0.55 + 0.02, 0.25 - 0.02)
    assert np.allclose(rig.where()["ball_1"][1], [0.55 + 0.033, 0.25 - 0.033, 0.005 + R])


def test_ball_let_go_above_another_rolls_to_the_nearest_free_place():
    rig = Rig([(0.5, 0.0), (0.3, 0.0)])
    rig.grasp(0.5, 0.0)
    rig.put_down(0.31, 0.0)
    label, place = rig.where()["ball_1"]
    assert label == "table" and 2 * R <= np.hypot(*(place[:2] - (0.3, 0.0))) < 2 * R + 0.005


def test_ball_let_go_on_the_rim_of_the_table_stays_and_beyond_it_is_elsewhere():
    rig = Rig([(0.5, 0.0), (0.6, 0.0)])
    rig.grasp(0.5, 0.0)
    rig.put_down(0.5, 0.499)
    rig.grasp(0.6, 0.0)
    rig.put_down(0.5, 0.501)
    where = rig.where()
    assert where["ball_1"][0] == "table" and where["ball_2"][0] == "elsewhere" and where["ball_2"][1][2] < -0.5
    assert rig.count("elsewhere") == 1 and rig.events()[-1] == "remove:ball_2"


def test_ball_let_go_beside_the_wall_keeps_clear_of_it():
    rig = Rig()
    rig.grasp(0.5, 0.0)
    rig.put_down(0.55, 0.25 - 0.09)
    label, place = rig.where()["ball_1"]
    assert label == "table" and place[1] <= 0.25 - 0.08 - R + 1e-9


def test_ball_taken_from_under_another_lets_it_sink():
    spots = [(0.3 + 0.07 * i, -0.2) for i in range(5)]
    rig = Rig(spots)
    for x, y in spots:
        rig.grasp(x, y)
        rig.put_down(*BOX)
    rig.events()
    below = next(i for i, (_, p) in rig.where().items() if p[2] < 0.05 and
                 np.allclose(p[:2], rig.where()["ball_5"][1][:2]))
    rig.edit("remove", below)
    rig.settle()
    assert rig.where()["ball_5"][1][2] == pytest.approx(0.035)
    assert rig.events() == [f"remove:{below}", "remove:ball_5", "add:ball_5"]


# --- edits ---


def test_added_ball_gets_the_next_free_id_and_lies_on_the_table():
    rig = Rig([(0.5, 0.0), (0.6, 0.0)])
    rig.edit("remove", "ball_1")
    assert rig.edit("add", at=(0.4, 0.2)) == "ball_1"
    assert rig.edit("add", at=(0.4, -0.2)) == "ball_3"
    assert np.allclose(rig.where()["ball_3"][1], [0.4, -0.2, R])
    assert rig.events() == ["remove:ball_1", "add:ball_1", "add:ball_3"]


def test_moved_ball_is_told_as_removed_and_added():
    rig = Rig()
    assert rig.edit("move", "ball_1", (0.4, 0.2)) == "ball_1"
    assert rig.events() == ["remove:ball_1", "add:ball_1"]
    assert rig.edit("move", "ball_1", (0.401, 0.2)) == "ball_1", "a little aside, over its own place"


@pytest.mark.parametrize("op", ["move", "remove", "reset"])
def test_held_ball_can_be_taken_out_of_the_fingers(op):
    rig = Rig()
    rig.grasp(0.5, 0.0)
    rig.edit(op, "ball_1", (0.3, 0.0) if op == "move" else None)
    assert rig.world.held == ""
    rig.tick(tool_down(0.5, 0.3, 0.3), 0.0)
    assert rig.width == 0.0, "the fingers close on air"


def test_ball_added_above_the_box_lies_in_a_slot_until_it_is_full():
    rig = Rig()
    for _ in range(8):
        rig.edit("add", at=BOX)
    assert rig.count("box") == 8
    with pytest.raises(Refused, match="box is full") as refusal:
        rig.edit("add", at=BOX)
    assert refusal.value.code == "container_full"


def test_reset_brings_the_first_layout_back():
    rig = Rig([(0.5, 0.0), (0.6, 0.0)])
    first = {name: tuple(position) for name, (_, position) in rig.where().items()}
    rig.grasp(0.5, 0.0)
    rig.edit("remove", "ball_2")
    rig.edit("add", at=(0.6, 0.0))
    assert rig.edit("reset") == ""
    assert {name: tuple(position) for name, (_, position) in rig.where().items()} == first


@pytest.mark.parametrize(
    ("op", "name", "at", "code", "text"),
    [
        ("add", "", (0.55, 0.01), "occupied", "overlaps ball_1"),
        ("add", "", (0.55, 0.25 - 0.1), "occupied", "box"),
        ("add", "", (0.55, 0.25 - 0.075), "occupied", "box"),
        ("add", "", (1.2, 0.0), "off_table", "x 0 to 1"),
        ("add", "", None, "no_position", "position"),
        ("add", "ball_1", (0.3, 0.0), "id_exists", "ball_1"),
        ("add", "no/slash", (0.3, 0.0), "bad_id", "no/slash"),
        ("move", "ball_1", (0.3, 0.0 - 0.9), "off_table", "y -0.5 to 0.5"),
        ("move", "ball_1", None, "no_position", "position"),
        ("move", "ball_9", (0.3, 0.0), "unknown_id", "choices: ball_1, ball_2"),
        ("remove", "bal_1", None, "unknown_id", "did you mean 'ball_1'"),
        ("remove", "", None, "unknown_id", "choices"),
    ],
)
def test_edit_that_can_not_be_is_refused_and_changes_nothing(op, name, at, code, text):
    rig = Rig([(0.5, 0.0), (0.3, 0.3)])
    before, version = str(rig.where()), rig.world.version
    with pytest.raises(Refused) as refusal:
        rig.edit(op, name, at)
    assert refusal.value.code == code and text in str(refusal.value)
    assert str(rig.where()) == before and rig.world.version == version and rig.events() == []


def test_place_to_which_a_ball_is_falling_is_taken():
    rig = Rig([(0.5, 0.0), (0.3, 0.0)])
    rig.grasp(0.5, 0.0)
    rig.release(0.4, 0.2)
    with pytest.raises(Refused, match="overlaps ball_1"):
        rig.edit("move", "ball_2", (0.41, 0.2))


@pytest.mark.parametrize("place", [(0.55, 0.17), (1.1, 0.0)])
def test_layout_that_can_not_be_is_a_configuration_error(place):
    with pytest.raises(ConfigError, match=r"world\.objects"):
        Rig([(0.5, 0.0), place])


def test_ball_of_the_layout_may_lie_in_the_box():
    assert Rig([BOX]).where()["ball_1"][0] == "box"


def test_nothing_new_is_said_while_nothing_moves():
    rig = Rig()
    version = rig.world.version
    rig.settle()
    assert rig.world.version == version


# --- whatever happens ---

places = st.tuples(st.floats(-0.1, 1.1), st.floats(-0.6, 0.6))
near_box = st.tuples(st.floats(0.4, 0.7), st.floats(0.1, 0.4))


class AnythingHappens(RuleBasedStateMachine):
    @initialize()
    def begin(self):
        self.rig = Rig([(0.40, -0.30), (0.52, -0.30), (0.64, -0.25), (0.40, -0.17), (0.52, -0.17)])
        self.count = 5

    @rule(number=st.integers(0, 20), off=st.floats(-0.012, 0.012))
    def grasp(self, number, off):
        lying = [p for label, p in self.rig.where().values() if label in ("table", "box")]
        if lying:
            place = lying[number % len(lying)]
            self.rig.grasp(place[0] + off, place[1], place[2])

    @rule(place=places | near_box, height=st.floats(0.02, 0.5), settle=st.booleans())
    def release(self, place, height, settle):
        self.rig.release(*place, height)
        if settle:
            self.rig.settle()

    @rule(op=st.sampled_from(["add", "move", "remove"]), number=st.integers(1, 12), place=places | near_box)
    def edit(self, op, number, place):
        known = set(self.rig.world.ids)
        try:
            self.rig.edit(op, f"ball_{number}", None if op == "remove" else place)
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
        assert len(self.rig.world.ids) == self.count == len(self.rig.where())
        assert self.rig.count("held") <= 1

    @invariant()
    def balls_at_rest_do_not_overlap(self):
        lying = {name: p for name, (label, p) in self.rig.where().items() if label in ("table", "box")}
        for (a, p), (b, q) in combinations(lying.items(), 2):
            assert np.linalg.norm(p - q) >= 2 * R - 1e-6, (a, p, b, q)

    @invariant()
    def balls_at_rest_are_carried(self):
        lying = [(label, p) for label, p in self.rig.where().values() if label in ("table", "box")]
        for label, p in lying:
            outside = max(abs(p[0] - 0.55), abs(p[1] - 0.25)) > 0.08
            assert outside == (label == "table")
            if label == "box" and p[2] > 0.05:
                assert any(np.allclose(p - [0, 0, 2 * R], q) for _, q in lying)


TestAnythingHappens = AnythingHappens.TestCase
TestAnythingHappens.settings = settings(max_examples=60, stateful_step_count=25, deadline=None)


# --- a ball that slips ---


def test_a_held_ball_slips_out_of_fingers_that_stay_closed_and_lies_where_it_fell():
    rig = Rig()
    rig.grasp(0.5, 0.0)
    rig.tick(tool_down(0.4, -0.1, 0.2))
    assert rig.edit("drop") == "ball_1"
    assert rig.world.held == "" and rig.world.obstruction(rig.hand, rig.width) == 0.0
    rig.settle()
    label, place = rig.where()["ball_1"]
    assert label == "table" and np.allclose(place, [0.4, -0.1, R], atol=0.011)
    assert rig.world.held == ""


def test_a_ball_that_slips_above_the_box_lies_in_it():
    rig = Rig()
    rig.grasp(0.5, 0.0)
    rig.tick(tool_down(*BOX, 0.2))
    rig.edit("drop", "ball_1")
    rig.settle()
    assert rig.where()["ball_1"][0] == "box"


@pytest.mark.parametrize("name", ["", "ball_1"])
def test_nothing_slips_out_of_an_empty_hand(name):
    rig = Rig()
    with pytest.raises(Refused, match="between the fingers") as refused:
        rig.edit("drop", name)
    assert refused.value.code == "not_held"
    assert rig.where()["ball_1"][0] == "table"


def test_world_takes_no_more_objects_than_can_be_told_of(monkeypatch) -> None:
    assert edits.MAX_OBJECTS <= 1000, "of messages"
    monkeypatch.setattr(edits, "MAX_OBJECTS", 3)
    world = Rig().world
    small = {"op": "add", "shape": "sphere", "size": Vector3(x=0.01)}
    for i in range(2):
        world.edit(WorldEdit(**small, position=Vector3(x=0.3 + 0.1 * i)), 0.0)
    with pytest.raises(Refused, match="at most 3"):
        world.edit(WorldEdit(**small, position=Vector3(x=0.7)), 0.0)
    world.edit(WorldEdit(op="remove", id="sphere_1"), 0.0)
    world.edit(WorldEdit(**small, position=Vector3(x=0.7)), 0.0)
    monkeypatch.setattr(edits, "MAX_OBJECTS", 100)
    monkeypatch.setattr(edits, "MAX_CORNERS", 500)
    cylinder_or_ring = {"op": "add", "shape": "cylinder", "size": Vector3(x=0.01, y=0.01, z=0.01)}
    world.edit(WorldEdit(**cylinder_or_ring, position=Vector3(x=0.3, y=0.2)), 0.0)
    with pytest.raises(Refused, match="at most 500"):
        world.edit(WorldEdit(**cylinder_or_ring, position=Vector3(x=0.4, y=0.2)), 0.0)


def test_cross_section_with_many_corners_that_point_inwards_is_refused() -> None:
    world = Rig().world
    asked = {"op": "add", "shape": "prism", "size": Vector3(x=0.04, y=0.04, z=0.02)}
    angles = np.linspace(0.0, 2 * math.pi, 1000, endpoint=False)
    around = np.column_stack([np.cos(angles), np.sin(angles)])
    star = around * np.where(np.arange(1000) % 2, 0.02, 0.01)[:, None]
    with pytest.raises(Refused, match="polygon: has 1000 corners"):
        world.edit(WorldEdit(**asked, polygon=star.tolist(), position=Vector3(x=0.3)), 0.0)
    world.edit(WorldEdit(**asked, polygon=(0.02 * around).tolist(), position=Vector3(x=0.3)), 0.0)


@pytest.mark.parametrize(("asked", "code"), [
    ({"shape": "prism", "polygon": [(0.1, 0.1)] * 3}, "no_size"),
    ({"shape": "prism", "polygon": [(0.0, 0.0), (0.1, 0.0), (0.2, 0.0)]}, "no_size"),
    ({"shape": "prism", "polygon": [(-1e7, 0.0), (1e7, 0.0), (0.0, 1e7)]}, "no_size"),
    ({"shape": "box", "size": Vector3(x=0.04, y=0.04, z=1e7)}, "no_size"),
    ({"shape": "sphere", "size": Vector3(x=1e7)}, "no_size"),
    ({"shape": "box", "position": Vector3(x=1e7, y=-1e7)}, "too_far"),
])
def test_what_no_message_could_tell_of_is_refused(asked: dict[str, object], code: str) -> None:
    given = {"op": "add", "size": Vector3(x=0.04, y=0.04, z=0.02), "position": Vector3(x=0.3), **asked}
    world = Rig().world
    with pytest.raises(Refused) as refused:
        world.edit(WorldEdit.model_validate(given), 0.0)
    assert refused.value.code == code


def test_inner_radius_of_what_is_no_ring_says_nothing() -> None:
    world = Rig().world
    name = world.edit(WorldEdit(op="add", shape="cylinder", size=Vector3(x=0.04, y=0.04, z=0.02), inner_radius=1e9,
                                position=Vector3(x=0.3)), 0.0)
    assert {thing.id: thing.inner_radius for thing in world.objects(Header()).objects}[name] == 0.0
