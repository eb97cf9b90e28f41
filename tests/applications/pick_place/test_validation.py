"""Detections become targets, rejections with a reason, unknown positions, or contents of the container."""

import numpy as np

from applications.pick_place.detections import Validation
from common.config import Surroundings
from common.messages import Header, Marker, MarkerArray, Pose, Vector3
from common.perception.pinhole import Pinhole

around = Surroundings()
camera = Pinhole.from_config(around.camera)


class Reach:
    """Fake cache: answers by the sign of y, and not beyond x = 0.6."""

    def known(self, place):
        x, y, _ = place
        return None if x > 0.6 else ("too far to the right" if y < 0 else "")


def validation(**values):
    return Validation(around, Reach(), **values)


def frame(*places, stamp=0.0, partial=False):
    markers = [Marker(ns="ball", id=i, type="sphere", pose=Pose(position=Vector3(x=x, y=y, z=0.03)), scale=Vector3(),
                      partial=partial) for i, (x, y) in enumerate(places)]
    return MarkerArray(header=Header(stamp=int(stamp * 1e9), frame_id="world"), markers=markers)


def test_detections_are_classified():
    places = frame((0.4, 0.05), (0.4, -0.2), (0.65, 0.0), (0.55, 0.25))
    judge = validation()
    verdict = judge.validate(places, camera)
    assert verdict.targets == [(0.4, 0.05, 0.03)]
    assert [one.reason for one in verdict.rejections] == ["too far to the right"]
    assert verdict.unknown == [(0.65, 0.0, 0.03)] == judge.unknown(places, camera)
    assert verdict.inside == 1


def test_contents_of_a_container_that_another_arm_fills_are_no_targets_and_no_rejections():
    two = Surroundings(containers={"near": {"x": 0.55, "y": 0.25}, "far": {"x": 0.5, "y": -0.25}})
    verdict = Validation(two, Reach()).validate(frame((0.4, 0.05), (0.5, -0.25), (0.55, 0.25)), camera)
    assert (verdict.targets, verdict.refused, verdict.inside) == ([(0.4, 0.05, 0.03)], [], 1)


def test_container_precedes_partial_view_precedes_reach():
    judge, reported = validation(), []
    for stamp in (0.0, 0.3, 0.6):  # one that is carried across the border is not reported
        verdict = judge.validate(frame((0.4, 0.05), (0.55, 0.25), stamp=stamp, partial=True), camera)
        reported.append([one.reason for one in verdict.rejections])
    assert reported == [[], [], ["partly out of view"]]
    assert verdict.inside == 1 and not verdict.targets


def test_rejected_position_is_reported_once_until_it_was_empty():
    judge = validation(forget_after=2.0)
    for stamp, places, reports in (
        (0, [(0.4, -0.2)], 1), (0, [(0.4, -0.2)], 0), (1.5, [(0.4, -0.201)], 0), (3.0, [(0.402, -0.2)], 0),
        (4.0, [], 0), (4.9, [(0.4, -0.2)], 0),  # a single frame without it is too short
        (6.0, [], 0), (7.0, [], 0), (7.1, [(0.4, -0.2)], 1),
    ):
        assert len(judge.validate(frame(*places, stamp=stamp), camera).rejections) == reports, stamp
    assert len(validation().validate(frame((0.4, -0.2), (0.4, -0.26)), camera).rejections) == 2, "touching balls"


def test_pixel_decides_whether_a_detection_is_in_the_container():
    place = camera.on_plane(camera.project((0.583, 0.283, 0.095)), 0.03)
    assert np.hypot(*(place - (0.583, 0.283))) > 0.02, "the top layer is seen far from where it is"
    assert validation().validate(frame(tuple(map(float, place))), camera).inside == 1


def test_remark_describes_visible_non_targets():
    judge = validation()
    small = frame((0.4, 0.05), (0.4, -0.2)).model_copy(update={"remark": "2 red blobs are smaller than 400"})
    for _ in range(2):  # the rejection is reported once, the remark with each frame
        verdict = judge.validate_views([(small, camera)])
        assert verdict.remark == "2 red blobs are smaller than 400, and 1 of 2 was rejected, too far to the right"
    assert judge.validate_views([(frame((0.4, 0.05)), camera)]).remark == ""
