from pathlib import Path

import pytest

from applications.pick_place.topics import SCENE_BALLS
from common import topics
from common.application import all_topics
from common.config import load_cell
from common.errors import ConfigError
from common.supervision.wiring import Wiring, wiring_of
from security.access import Rights, access_control, rights_of, rights_of_recorder, rights_of_supervisor
from security.validation import allowances, require_current

RENEW = "zencell secure init DIR --renew"
PLACE = Path("certs")
CAMERA = Wiring(reads={SCENE_BALLS}, writes={topics.CAMERA_IMAGE, topics.CAMERA_INFO})
TASK = Wiring(reads={topics.GRIPPER_STATE}, calls={topics.GRIPPER_COMMAND, topics.PARAMETERS})
EXECUTOR = Wiring(writes={topics.GRIPPER_STATE}, serves={topics.GRIPPER_COMMAND})


def cell(**declared: Wiring) -> dict[str, Rights]:
    return {name: rights_of(name, wiring) for name, wiring in declared.items()}


def allowed(**declared: Wiring) -> dict[str, dict[str, set[str]]]:
    return allowances(access_control({"panda": cell(**declared)}))


def test_service_may_do_exactly_what_it_declares() -> None:
    camera = allowed(camera=CAMERA)["panda.camera"]
    assert camera["writes"] == {"panda/camera/image_raw", "panda/camera/camera_info", "panda/log/camera",
                                "panda/counters/camera"}
    assert camera["answers"] == {"panda/camera/camera_info", "panda/param/camera", "panda/counters/camera"}
    assert camera["reads"] == camera["asks"] == {"panda/scene_balls"}
    owned = ("camera|image_raw", "camera|camera_info", "log|camera", "counters|camera", "param|camera")
    assert camera["is there"] == {"panda/alive/camera", "panda/serves/param/camera/camera",
                                  *(f"panda/owns/{key}/*/camera/*" for key in owned)}


def test_client_may_query_and_server_may_reply_and_only_the_operator_may_jog() -> None:
    may = allowed(task=TASK, executor=EXECUTOR)
    assert may["panda.task"]["asks"] == {"panda/gripper/command", "panda/gripper/state", "panda/param/*"}
    assert may["panda.task"]["answers"] == {"panda/param/task", "panda/counters/task"}
    assert may["panda.executor"]["answers"] == {"panda/gripper/command", "panda/gripper/state", "panda/param/executor",
                                                "panda/counters/executor"}
    assert "asks" not in may["panda.executor"]
    assert may["operator"]["writes"] == {"*/motion/jog"} and "writes" not in may["observer"]


def test_all_else_is_denied_and_only_the_rule_for_subscriptions_names_no_cell() -> None:
    control = access_control({"panda": {**cell(camera=CAMERA), "supervisor": rights_of_supervisor()}})
    assert control["enabled"] and control["default_permission"] == "deny"
    for rule in control["rules"]:
        assert rule["permission"] == "allow"
        if rule["id"].startswith("panda.") and not all(key.startswith("panda/") for key in rule["key_exprs"]):
            # Readers may subscribe with any expression.
            assert (rule["flows"], rule["messages"], rule["key_exprs"]) == (["egress"], ["declare_subscriber"], ["**"])


@pytest.mark.parametrize("name", ["observer", "panda.recorder"])
def test_observer_and_recorder_may_query_states_and_no_request(name: str) -> None:
    asks = allowances(access_control({"panda": {"recorder": rights_of_recorder()}}))[name]["asks"]
    states = {topic.expression for topic in all_topics().values() if topic.kind == "state"}
    assert {key.partition("/")[2] for key in asks} == states | {f"*/{key}" for key in states}, "also of arms"


@pytest.mark.parametrize("name", ["panda", "ur5"])
async def test_only_operators_and_the_page_may_recover_the_arm(name: str) -> None:
    loaded = load_cell(name)
    rights = {entry.name: rights_of(entry.name, await wiring_of(loaded, entry)) for entry in loaded.services.values()}
    may = allowances(access_control({name: {**rights, "recorder": rights_of_recorder()}}))
    recover = {f"{name}/robot/command", "*/**"}
    callers = {caller for caller, rights in may.items() if recover & rights.get("asks", set())}
    assert callers == {f"{name}.viewer", "operator"}


def test_rules_that_match_the_services_are_current() -> None:
    rights = cell(camera=CAMERA, task=TASK)
    rules = access_control({"panda": rights, "ur5": cell(other=EXECUTOR)})
    require_current(PLACE, rules, "panda", rights, RENEW)
    require_current(PLACE, rules, "panda", cell(camera=CAMERA), RENEW)  # a host may start only some of the services


@pytest.mark.parametrize(("before", "now", "reason"), [
    ({"camera": CAMERA}, {"camera": CAMERA, "task": TASK}, "has no rules for panda.task"),
    ({"task": Wiring()}, {"task": TASK}, r"panda\.task than it declares now.*gripper/command is not allowed"),
    ({"task": TASK}, {"task": Wiring()}, r"panda\.task than it declares now.*is allowed and not needed"),
])
def test_missing_or_different_rules_of_a_service_are_rejected_by_name(before, now, reason: str) -> None:
    with pytest.raises(ConfigError, match=rf"{reason}.*{RENEW}"):
        require_current(PLACE, access_control({"panda": cell(**before)}), "panda", cell(**now), RENEW)
