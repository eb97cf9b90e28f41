"""What the page says is lost, and when a word counts as one of before."""

from __future__ import annotations

from page.losses import BLINK, Loss, LossDetector

from page.control_socket import LATE, Delays

THERE = {"arm": ("no arm", True), "task": ("no task", True)}


def seen(*services: str) -> LossDetector:
    losses = LossDetector()
    assert losses.update(True, services, THERE, 0.0) == []
    return losses


def test_what_never_was_is_not_lost_but_started() -> None:
    assert LossDetector().update(True, [], {"arm": ("no arm", False)}, 100.0) == []


def test_service_that_is_gone_is_told_with_the_time_when_it_went_and_no_more_when_it_is_back() -> None:
    losses = seen("camera", "viewer")
    assert losses.update(True, ["viewer"], THERE, 5.0) == [], "one that blinks is not told"
    assert losses.update(True, ["viewer"], THERE, 5.0 + BLINK) == [Loss("camera does not answer", 5.0)]
    assert losses.update(True, ["viewer", "camera"], THERE, 8.0) == []
    assert losses.update(True, ["viewer"], THERE, 9.0) == [], "it blinks anew"


def test_part_for_which_nobody_answers_is_unknown() -> None:
    losses, gone = seen("executor"), {"arm": ("no arm", False), "task": ("no task", True)}
    losses.update(True, [], gone, 1.0)
    assert losses.update(True, [], gone, 3.0) == [
        Loss("no arm", 1.0, frozenset({"arm"})), Loss("executor does not answer", 1.0)]


def test_without_the_router_that_is_the_only_news_and_nothing_is_known() -> None:
    losses, nobody = seen("camera"), {"arm": ("no arm", False), "task": ("no task", False)}
    for now in (2.0, 9.0):
        (loss,) = losses.update(False, [], nobody, now)
        assert (loss.since, loss.unknown) == (2.0, {"all"}) and "router" in loss.what
    assert losses.update(True, [], nobody, 10.0) == [], "those who come back have a moment"
    assert losses.update(True, ["camera"], THERE, 10.5) == []


def test_word_that_waited_on_its_way_is_late_whatever_the_clocks_say() -> None:
    delays = Delays()
    assert [delays.late(1, 1000.0 + at, 5.0 + at) for at in (0.0, 0.25)] == [0.0, 0.0]
    assert delays.late(1, 1000.5, 5.5 + 0.4) > LATE, "it was held up"
    assert delays.late(1, 1001.0, 6.0625) < LATE
    assert delays.late(2, 1002.0, 9000.0) == 0.0, "the browser's machine slept meanwhile"


def test_names_that_somebody_makes_up_again_and_again_are_neither_kept_for_ever_nor_all_told() -> None:
    losses = LossDetector()
    for number in range(1000):
        losses.update(True, ["camera", f"made up {number:04}"], {}, float(number))
    losses.update(True, ["camera"], {}, 1000.0)
    (lost,) = losses.update(True, ["camera"], {}, 2000.0)
    assert lost.what.endswith(" and 92 more do not answer") and "made up 0900" in lost.what
    losses.update(True, [], {}, 2010.0)
    (lost,) = losses.update(True, [], {}, 2020.0)
    assert "camera" in lost.what, "what was there last is told"
