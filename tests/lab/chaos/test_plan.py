"""Fault plans of real cells, and damaged payloads."""

from __future__ import annotations

import math
from itertools import islice
from typing import get_args

import numpy as np
import pytest

from applications.pick_place.topics import PickPlaceStatus
from common.errors import DecodeError
from common.messages import Image, StopRequest
from common.transport import codec
from common.transport.ownership import Owner
from common.transport.reader import SequenceFilter
from common.transport.session import RawSample
from lab.chaos.agent import damaged, invalid_payload, keys_of, next_damaged
from lab.chaos.plan import LABELS, Fault, Form, Kind, faults, plan

PROCESSES = ["router", "motion_planner", "trajectory_executor", "smart_pick_place"]
KEYS = ["camera/image_raw", "gripper/state", "motion/plan"]


def planned(seed: int, *, objects: bool = True, seconds: float = 60.0) -> list[Fault]:
    return plan(seed, PROCESSES, KEYS, objects=objects, seconds=seconds, per_minute=30.0)


def test_plan_is_decided_by_its_seed() -> None:
    assert planned(3) == planned(3)
    assert planned(3) != planned(4)
    assert planned(3, seconds=20.0) == [fault for fault in planned(3) if fault.at <= 20.0]


def test_every_kind_form_process_and_key_occurs_but_no_slip_without_objects() -> None:
    every = [fault for seed in range(20) for fault in planned(seed)]
    assert {fault.kind for fault in every} == set(get_args(Kind)) == set(LABELS)
    assert {fault.form for fault in every} == set(get_args(Form))
    assert {f.target for f in every if f.kind in ("kill", "restart", "freeze", "delay")} == set(PROCESSES)
    assert {f.target for f in every if f.kind in ("corrupt", "replay")} == set(KEYS)
    assert any(fault.holding for fault in every)
    assert {math.isfinite(f.seconds) for f in every if f.kind == "freeze"} == {True, False}
    assert all(math.isfinite(f.seconds) for f in every if f.kind != "freeze")
    without = [fault for seed in range(20) for fault in planned(seed, objects=False)]
    assert not any(fault.kind == "drop" or fault.holding for fault in without)


@pytest.mark.parametrize("per_minute", [6.0, 120.0])
def test_faults_are_in_order_and_as_frequent_as_requested(per_minute: float) -> None:
    times = [fault.at for fault in islice(faults(1, PROCESSES, KEYS, objects=True, per_minute=per_minute), 1000)]
    assert times == sorted(times) and 0.8 * per_minute < 60 * len(times) / times[-1] < 1.3 * per_minute



def test_keys_are_those_that_services_write_or_serve_with_the_topics_of_their_own_keys() -> None:
    owned = {"trajectory_executor": ["motion/execute", "joint_states", "param/trajectory_executor"],
             "scene_manager": ["planning_scene"], "camera_simulator": ["camera/image_raw"]}
    owners = [Owner(key, key, service, "1") for service, keys in owned.items() for key in keys]
    assert list(keys_of(owners, ["trajectory_executor", "scene_manager"])) == [
        "planning_scene", "joint_states", "motion/execute"]
    own = "camera/image_raw"
    known = keys_of([Owner(f"{side}/{own}", own, f"{side}_camera", "1") for side in ("left", "right")],
                    ["left_camera", "right_camera"])
    assert list(known) == ["left/camera/image_raw", "right/camera/image_raw"]
    assert all(topic.key == key and topic.message is Image for key, topic in known.items())


@pytest.mark.parametrize("form", [form for form in get_args(Form) if form])
def test_damaged_message_is_rejected(form: Form) -> None:
    key, payload = "panda/pick_place_status", codec.encode(PickPlaceStatus(placed=3))
    attachment = codec.Attachment("smart_pick_place.1", 7, checksum=codec.checksum_of(key, payload))
    codec.require_intact(attachment, key, payload)
    for seed in range(1 if form == "huge" else 50):
        bad = damaged(payload, form, np.random.default_rng(seed))
        with pytest.raises(DecodeError):
            codec.require_intact(attachment, key, bad)
            codec.decode(PickPlaceStatus, bad)


def test_noise_and_wrong_types_are_rejected_without_a_checksum() -> None:
    for seed in range(50):
        for form in ("wrong type", "noise"):
            with pytest.raises(DecodeError):
                codec.decode(StopRequest, invalid_payload(StopRequest, form, np.random.default_rng(seed)))
        with pytest.raises(DecodeError):
            codec.decode(PickPlaceStatus, damaged(b"", "noise", np.random.default_rng(seed)))


def test_image_damaged_beyond_its_checksum_costs_one_image() -> None:
    key, payload, rng = "ur5/depth_camera/image_raw", bytes(2 * codec.CHECKED_BYTES), np.random.default_rng(0)
    seventh, eighth, ninth = (
        codec.Attachment("depth_camera.1", number, checksum=codec.checksum_of(key, payload)) for number in (7, 8, 9))
    newness = SequenceFilter()
    assert newness.is_new(seventh)
    real = RawSample(key, payload, "", codec.encode_attachment(seventh))
    bad = (next_damaged(real, seventh, "flipped", rng) for _ in range(100))
    checked = slice(codec.CHECKED_BYTES)
    body, encoded = next((body, encoded) for body, encoded in bad if body[checked] == payload[checked])
    attachment = codec.decode_attachment(encoded)
    assert attachment is not None and body != payload
    codec.require_intact(attachment, key, body)
    assert newness.is_new(attachment) and not newness.is_new(eighth) and newness.is_new(ninth)
