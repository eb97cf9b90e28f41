"""What a supervisor passes on of the services that run on other hosts."""

from __future__ import annotations

from common.messages import Notice, ServiceStatus, SupervisorStatus
from common.supervision.liveness_watchdog import MOST_ELSEWHERE, Elsewhere
from common.transport.codec import decode, encode


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


def test_whatever_others_make_up_there_is_room_for_it_beside_our_own() -> None:
    elsewhere, long = Elsewhere("arm", ["motion_planner"]), "\N{MATHEMATICAL BOLD CAPITAL A}"
    for number in range(30):
        host = f"{number:03}" + long * 117
        elsewhere.hear(SupervisorStatus(
            cell="toy", host=host, notices=[Notice(message=long * 4000, host=host)] * 1000, services=[
                ServiceStatus(name=f"{number:03}{i:04}" + long * 113, host=host, state="waiting", message=long * 4000)
                for i in range(1000)]))
    elsewhere.hear(said("camera", ("vision_detector", "camera", "ready")))
    own = [ServiceStatus(name=f"service_{i}", state="ready") for i in range(20)]
    told = SupervisorStatus(
        cell="toy", services=[*own, *elsewhere.statuses({"vision_detector"})], notices=elsewhere.notices)
    heard = decode(SupervisorStatus, encode(told)).services
    assert len(heard) == 20 + MOST_ELSEWHERE and heard[-1].name == "vision_detector"
    assert len(elsewhere._notices) <= 10 and len(elsewhere._lately) == MOST_ELSEWHERE
