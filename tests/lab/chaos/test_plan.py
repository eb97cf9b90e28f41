"""Fault plans of real cells, and damaged payloads."""

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
    require_intact,
)
from common.transport.ownership import Owner
from common.transport.reader import SequenceFilter
from common.transport.session import RawSample
from lab.chaos.agent import damaged, invalid_payload, keys_of, next_damaged
from lab.chaos.plan import CELL_SECONDS, LABELS, Fault, Form, Kind, faults, plan

PROCESSES = ["router", "motion_planner", "trajectory_executor", "smart_pick_place"]
KEYS = ["camera/image_raw", "gripper/state", "motion/plan"]


def planned(seed: int, *, objects: bool = True, seconds: float = 60.0, per_minute: float = 30.0) -> list[Fault]:
    return plan(seed, PROCESSES, KEYS, objects=objects, seconds=seconds, per_minute=per_minute)


def test_plan_is_decided_by_its_seed() -> None:
    assert planned(3) == planned(3)
    assert planned(3) != planned(4)
    assert planned(3, seconds=20.0) == [fault for fault in planned(3) if fault.at <= 20.0]


def test_every_kind_form_process_and_key_occurs() -> None:
    every = [fault for seed in range(20) for fault in planned(seed)]
    assert {fault.kind for fault in every} == set(get_args(Kind)) == set(LABELS)
    assert {fault.form for fault in every} == set(get_args(Form))
    assert {f.target for f in every if f.kind in ("kill", "restart", "freeze", "delay")} == set(PROCESSES)
    assert {f.target for f in every if f.kind in ("corrupt", "replay")} == set(KEYS)
    assert any(fault.holding for fault in every)
    assert {math.isfinite(f.seconds) for f in every if f.kind == "freeze"} == {True, False}
    assert all(math.isfinite(f.seconds) for f in every if f.kind != "freeze")


def test_without_objects_none_slips_and_no_fault_waits_for_one() -> None:
    every = [fault for seed in range(20) for fault in planned(seed, objects=False)]
    assert not any(fault.kind == "drop" or fault.holding for fault in every)


@pytest.mark.parametrize("per_minute", [6.0, 30.0, 120.0])
def test_faults_are_in_order_and_as_frequent_as_requested(per_minute: float) -> None:
    many = list(islice(faults(1, PROCESSES, KEYS, objects=True, per_minute=per_minute), 2000))
    times = [fault.at for fault in many]
    assert times == sorted(times)
    assert 0.8 * per_minute < 60 * len(many) / times[-1] < 1.3 * per_minute


def test_most_runs_at_speed_5_have_four_to_twelve_faults() -> None:
    counts = Counter(len(planned(seed, seconds=CELL_SECONDS / 5)) for seed in range(100))
    assert sum(n for count, n in counts.items() if 4 <= count <= 12) > 85


def test_fault_is_formatted_in_one_line() -> None:
    assert str(Fault(1.0, "kill", "vision_detector")) == "kill -9 vision_detector"
    assert str(Fault(1.0, "freeze", "router", 2.14, holding=True)) == "SIGSTOP router: 2.1 s, while holding an object"
    assert str(Fault(1.0, "freeze", "tf", math.inf)) == "SIGSTOP tf: until a watchdog acts"
    corrupt = Fault(1.0, "corrupt", "tf", form="truncated", count=12)
    assert (str(corrupt), corrupt.what) == ("damaged messages on tf: 12 truncated", "damaged messages on: 12 truncated")
    assert str(Fault(1.0, "drop")) == "held object slips"


def test_keys_are_those_that_services_write_or_serve() -> None:
    owned = {"trajectory_executor": ["motion/execute", "joint_states", "param/trajectory_executor"],
             "scene_manager": ["planning_scene"], "camera_simulator": ["camera/image_raw"]}
    owners = [Owner(key, key, service, "1") for service, keys in owned.items() for key in keys]
    assert list(keys_of(owners, ["trajectory_executor", "scene_manager"])) == [
        "planning_scene", "joint_states", "motion/execute"]


def test_remapped_key_has_the_topic_of_its_services_own_key() -> None:
    own = "camera/image_raw"
    owners = [Owner(f"{side}/{own}", own, f"{side}_camera", "1") for side in ("left", "right")]
    known = keys_of(owners, ["left_camera", "right_camera"])
    assert list(known) == ["left/camera/image_raw", "right/camera/image_raw"]
    assert all(topic.key == key and topic.message is Image for key, topic in known.items())


@pytest.mark.parametrize("form", [form for form in get_args(Form) if form])
def test_damaged_message_is_rejected(form: Form) -> None:
    payload = encode(PickPlaceStatus(placed=3))
    attachment = Attachment("smart_pick_place.1", 7, checksum=checksum_of("panda/pick_place_status", payload))
    require_intact(attachment, "panda/pick_place_status", payload)
    for seed in range(50):
        bad = damaged(payload, form, np.random.default_rng(seed))
        with pytest.raises(DecodeError):
            require_intact(attachment, "panda/pick_place_status", bad)
            decode(PickPlaceStatus, bad)
        if form == "huge":
            break


def test_image_damaged_beyond_its_checksum_costs_one_image() -> None:
    key, payload = "ur5/depth_camera/image_raw", bytes(2 * CHECKED_BYTES)
    rng = np.random.default_rng(0)

    def attachment_of(number: int) -> Attachment:
        return Attachment("depth_camera.1", number, checksum=checksum_of(key, payload))

    newness = SequenceFilter()
    assert newness.is_new(attachment_of(7))
    real = RawSample(key, payload, "", encode_attachment(attachment_of(7)))
    bad = (next_damaged(real, attachment_of(7), "flipped", rng) for _ in range(100))
    body, encoded = next((body, encoded) for body, encoded in bad if body[:CHECKED_BYTES] == payload[:CHECKED_BYTES])
    attachment = decode_attachment(encoded)
    assert attachment is not None and body != payload
    require_intact(attachment, key, body)
    assert newness.is_new(attachment) and not newness.is_new(attachment_of(8)) and newness.is_new(attachment_of(9))


@pytest.mark.parametrize("form", ["wrong type", "noise"])
def test_nonsense_is_never_a_valid_request(form: Form) -> None:
    for seed in range(200):
        with pytest.raises(DecodeError):
            decode(StopRequest, invalid_payload(StopRequest, form, np.random.default_rng(seed)))


def test_noise_without_a_checksum_is_rejected() -> None:
    for seed in range(50):
        with pytest.raises(DecodeError):
            decode(PickPlaceStatus, damaged(b"", "noise", np.random.default_rng(seed)))
