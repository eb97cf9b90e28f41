"""Plans of faults: the same seed plans the same ones, and over seeds there is something of everything."""

from __future__ import annotations

import math
from collections import Counter
from itertools import islice
from typing import get_args

import numpy as np
import pytest

from applications.pick_place.topics import PickPlaceStatus
from common.errors import DecodeError
from common.messages import Image, StopRequest
from common.transport.codec import (
    CHECKED_BYTES,
    Attachment,
    checksum_of,
    decode,
    decode_attachment,
    encode,
    encode_attachment,
    require_whole,
)
from common.transport.ownership import Owner
from common.transport.reader import Newness
from common.transport.session import RawSample
from lab.chaos.agent import damaged, keys_of, next_damaged, nonsense
from lab.chaos.plan import CELL_SECONDS, LABELS, Fault, Form, Kind, faults, plan

PROCESSES = ["router", "motion_planner", "trajectory_executor", "smart_pick_place"]
KEYS = ["camera/image_raw", "gripper/state", "motion/plan"]


def planned(seed: int, *, objects: bool = True, seconds: float = 60.0, per_minute: float = 30.0) -> list[Fault]:
    return plan(seed, PROCESSES, KEYS, objects=objects, seconds=seconds, per_minute=per_minute)


def test_the_same_seed_plans_the_same_faults_and_another_one_others() -> None:
    assert planned(3) == planned(3)
    assert planned(3) != planned(4)
    assert planned(3, seconds=20.0) == [fault for fault in planned(3) if fault.at <= 20.0]


def test_every_kind_form_process_and_key_occurs_over_seeds() -> None:
    every = [fault for seed in range(20) for fault in planned(seed)]
    assert {fault.kind for fault in every} == set(get_args(Kind)) == set(LABELS)
    assert {fault.form for fault in every} == set(get_args(Form))
    assert {f.target for f in every if f.kind in ("kill", "restart", "freeze", "delay")} == set(PROCESSES)
    assert {f.target for f in every if f.kind in ("corrupt", "replay")} == set(KEYS)
    assert any(fault.holding for fault in every)
    assert {math.isfinite(f.seconds) for f in every if f.kind == "freeze"} == {True, False}
    assert all(math.isfinite(f.seconds) for f in every if f.kind != "freeze")


def test_no_ball_slips_and_nothing_waits_for_one_where_there_are_none() -> None:
    every = [fault for seed in range(20) for fault in planned(seed, objects=False)]
    assert not any(fault.kind == "drop" or fault.holding for fault in every)


@pytest.mark.parametrize("per_minute", [6.0, 30.0, 120.0])
def test_faults_come_in_order_and_about_as_often_as_asked(per_minute: float) -> None:
    many = list(islice(faults(1, PROCESSES, KEYS, objects=True, per_minute=per_minute), 2000))
    times = [fault.at for fault in many]
    assert times == sorted(times)
    assert 0.8 * per_minute < 60 * len(many) / times[-1] < 1.3 * per_minute


def test_a_run_at_speed_5_sees_five_to_ten_faults_as_a_rule() -> None:
    counts = Counter(len(planned(seed, seconds=CELL_SECONDS / 5)) for seed in range(100))
    assert sum(n for count, n in counts.items() if 4 <= count <= 12) > 85


def test_faults_are_told_in_a_line() -> None:
    assert str(Fault(1.0, "kill", "vision_detector")) == "kill -9 vision_detector"
    assert str(Fault(1.0, "freeze", "router", 2.14, holding=True)) == "SIGSTOP router: 2.1 s, something in the hand"
    assert str(Fault(1.0, "freeze", "tf", math.inf)) == "SIGSTOP tf: until it is noticed"
    corrupt = Fault(1.0, "corrupt", "tf", form="truncated", count=12)
    assert (str(corrupt), corrupt.what) == ("damaged messages on tf: 12 truncated", "damaged messages on: 12 truncated")
    assert str(Fault(1.0, "drop")) == "what is held slips"


def test_keys_are_those_that_the_services_write_or_answer() -> None:
    owned = {"trajectory_executor": ["motion/execute", "joint_states", "param/trajectory_executor"],
             "scene_manager": ["planning_scene"], "camera_simulator": ["camera/image_raw"]}
    owners = [Owner(key, key, service, "1") for service, keys in owned.items() for key in keys]
    assert list(keys_of(owners, ["trajectory_executor", "scene_manager"])) == [
        "planning_scene", "joint_states", "motion/execute"]


def test_a_key_under_another_name_is_disturbed_as_what_its_service_calls_it() -> None:
    own = "camera/image_raw"
    owners = [Owner(f"{side}/{own}", own, f"{side}_camera", "1") for side in ("left", "right")]
    known = keys_of(owners, ["left_camera", "right_camera"])
    assert list(known) == ["left/camera/image_raw", "right/camera/image_raw"]
    assert all(topic.key == key and topic.message is Image for key, topic in known.items())


@pytest.mark.parametrize("form", [form for form in get_args(Form) if form])
def test_damaged_messages_are_refused(form: Form) -> None:
    payload = encode(PickPlaceStatus(placed=3))
    attachment = Attachment("smart_pick_place.1", 7, checksum=checksum_of("panda/pick_place_status", payload))
    require_whole(attachment, "panda/pick_place_status", payload)
    for seed in range(50):
        bad = damaged(payload, form, np.random.default_rng(seed))
        with pytest.raises(DecodeError):
            require_whole(attachment, "panda/pick_place_status", bad)
            decode(PickPlaceStatus, bad)
        if form == "huge":
            break


def test_a_picture_that_is_damaged_where_no_checksum_looks_costs_one_picture() -> None:
    key, payload = "ur5/depth_camera/image_raw", bytes(2 * CHECKED_BYTES)
    rng = np.random.default_rng(0)

    def heard(number: int) -> Attachment:
        return Attachment("depth_camera.1", number, checksum=checksum_of(key, payload))

    newness = Newness()
    assert newness.is_new(heard(7))
    real = RawSample(key, payload, "", encode_attachment(heard(7)))
    bad = (next_damaged(real, heard(7), "flipped", rng) for _ in range(100))
    body, beside = next((body, beside) for body, beside in bad if body[:CHECKED_BYTES] == payload[:CHECKED_BYTES])
    attachment = decode_attachment(beside)
    assert attachment is not None and body != payload
    require_whole(attachment, key, body)
    assert newness.is_new(attachment) and not newness.is_new(heard(8)) and newness.is_new(heard(9))


@pytest.mark.parametrize("form", ["wrong type", "noise"])
def test_nonsense_is_never_a_request_that_somebody_could_have_made(form: Form) -> None:
    for seed in range(200):
        with pytest.raises(DecodeError):
            decode(StopRequest, nonsense(StopRequest, form, np.random.default_rng(seed)))


def test_bytes_from_nowhere_are_refused_without_a_checksum_too() -> None:
    for seed in range(50):
        with pytest.raises(DecodeError):
            decode(PickPlaceStatus, damaged(b"", "noise", np.random.default_rng(seed)))
