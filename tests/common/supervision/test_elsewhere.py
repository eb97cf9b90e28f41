"""What a supervisor passes on of the services that run on other hosts."""

from __future__ import annotations

from common.messages import ServiceStatus, SupervisorStatus
from common.supervision.liveness_watchdog import Elsewhere


def said(host: str, *services: tuple[str, str, str]) -> SupervisorStatus:
    return SupervisorStatus(
        cell="toy", host=host, services=[ServiceStatus(name=n, host=h, state=s) for n, h, s in services]
    )


def test_each_supervisor_tells_of_the_services_of_the_others_under_their_host() -> None:
    elsewhere = Elsewhere("arm", ["router", "motion_planner"])
    elsewhere.hear(said("camera", ("router", "camera", "ready"), ("vision_detector", "camera", "ready")))
    assert [(s.name, s.host, s.state) for s in elsewhere.statuses({"vision_detector"})] == [
        ("vision_detector", "camera", "ready")
    ]


def test_what_another_supervisor_only_passes_on_is_not_news() -> None:
    elsewhere = Elsewhere("arm", ["motion_planner"])
    elsewhere.hear(said("camera", ("motion_planner", "arm", "failed"), ("smart_pick_place", "third", "failed")))
    assert elsewhere.statuses(set()) == []


def test_a_service_behind_a_cut_link_is_not_told_of_as_ready() -> None:
    elsewhere = Elsewhere("arm", [])
    elsewhere.hear(said("camera", ("vision_detector", "camera", "ready")))
    (gone,) = elsewhere.statuses(set())
    assert (gone.state, gone.message) == ("waiting", "on camera, which is not reached")
    (back,) = elsewhere.statuses({"vision_detector"})
    assert (back.state, back.message) == ("ready", "")


def test_own_services_are_told_of_with_the_name_of_this_host() -> None:
    (own,) = Elsewhere("arm", ["motion_planner"]).ours([ServiceStatus(name="motion_planner", state="ready")])
    assert own.host == "arm"
