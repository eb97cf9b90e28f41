import numpy as np

from applications.pick_place.detections import Validation
from common.config import Surroundings
from common.messages import Header, Marker, MarkerArray, Pose, Vector3
from common.perception.pinhole import Pinhole

around = Surroundings()
camera = Pinhole.from_config(around.camera)
SECOND = 10**9


class Reach:
    """Fake cache: answers by the sign of y, and not beyond x = 0.6."""

    def known(self, place):
        x, y, _ = place
        return None if x > 0.6 else ("too far to the right" if y < 0 else "")


def validation(**values):
    return Validation(around, Reach(), **values)


def frame(*places, stamp=0, partial=False):
    return MarkerArray(
        header=Header(stamp=stamp, frame_id="world"),
        markers=[
            Marker(
                ns="ball", id=i, type="sphere", pose=Pose(position=Vector3(x=x, y=y, z=0.03)), scale=Vector3(),
                partial=partial,
            )
            for i, (x, y) in enumerate(places)
        ],
    )  # fmt: skip


def test_detections_are_classified():
    places = frame((0.4, 0.05), (0.4, -0.2), (0.65, 0.0), (0.55, 0.25))
    judge = validation()
    verdict = judge.validate(places, camera)
    assert verdict.targets == [(0.4, 0.05, 0.03)]
    assert [one.reason for one in verdict.rejections] == ["too far to the right"]
    assert verdict.unknown == [(0.65, 0.0, 0.03)] == judge.unknown(places, camera)
    assert verdict.inside == 1


def test_container_precedes_partial_view_precedes_reach():
    verdict = validation().validate(frame((0.4, 0.05), (0.55, 0.25), partial=True), camera)
    assert [one.reason for one in verdict.rejections] == ["partly out of view"]
    assert verdict.inside == 1 and not verdict.targets


def test_rejected_position_is_reported_once_until_it_was_empty():
    judge = validation(forget_after=2.0)

    def reports(stamp, *places):
        return len(judge.validate(frame(*places, stamp=int(stamp * SECOND)), camera).rejections)

    assert reports(0, (0.4, -0.2)) == 1
    assert reports(1.5, (0.4, -0.201)) == 0
    assert reports(3.0, (0.402, -0.2)) == 0, "it was never empty"
    assert reports(4.0) == 0
    assert reports(4.9, (0.4, -0.2)) == 0, "a frame without it is no while"
    assert reports(6.0) == reports(7.0) == 0
    assert reports(7.1, (0.4, -0.2)) == 1


def test_touching_balls_are_different_positions():
    verdict = validation().validate(frame((0.4, -0.2), (0.4, -0.26)), camera)
    assert len(verdict.rejections) == 2


def test_validating_a_frame_twice_reports_once():
    judge, seen = validation(), frame((0.4, -0.2), (0.4, 0.1))
    first, second = judge.validate(seen, camera), judge.validate(seen, camera)
    assert first.targets == second.targets and len(first.rejections) == 1 and not second.rejections


def test_pixel_decides_whether_a_detection_is_in_the_container():
    place = camera.on_plane(camera.project((0.583, 0.283, 0.095)), 0.03)
    seen = frame((float(place[0]), float(place[1])))
    assert np.hypot(*(place - (0.583, 0.283))) > 0.02, "the top layer is seen far from where it is"
    assert validation().validate(seen, camera).inside == 1


def test_remark_describes_visible_non_targets():
    judge = validation()
    small = frame((0.4, 0.05), (0.4, -0.2)).model_copy(update={"remark": "2 red blobs are smaller than 400"})
    for _ in range(2):  # the rejection is reported once, the remark with each frame
        verdict = judge.validate_views([(small, camera)])
        assert verdict.remark == "2 red blobs are smaller than 400, and 1 of 2 was rejected, too far to the right"
    assert judge.validate_views([(frame((0.4, 0.05)), camera)]).remark == ""
