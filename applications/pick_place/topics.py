"""Keys of pick and place."""

from __future__ import annotations

from applications.pick_place.messages import PickPlaceStatus
from common import messages as m
from common.topics import Topic

SCENE_BALLS = Topic("scene_balls", m.PoseArray, "state", "the truth: where every ball is; simulated hardware only")
DETECTED_OBJECTS = Topic("detected_objects", m.MarkerArray, "stream", "balls found in the picture, in world")
DETECTION_IMAGE = Topic("detection_image", m.Image, "stream", "the picture with what was found")
DETECTION_MASK = Topic("detection_image/mask", m.Image, "stream",
                       "white where the picture has a colour that is looked for; sent only while someone listens")
VALIDATED_TARGETS = Topic("validated_targets", m.PoseArray, "stream", "detections that the arm can take, in world")
REJECTED_TARGETS = Topic("rejected_targets", m.Rejections, "event",
                         "detections that it cannot take, with the reason, once for each place")
WORKSPACE_MARKERS = Topic("workspace_markers", m.MarkerArray, "state",
                          "reachable shell and excluded column as cylinders")
PICK_PLACE_STATUS = Topic("pick_place_status", PickPlaceStatus, "state",
                          "IDLE, GRASPING, PLACING, HOMING, DONE or ERROR, and counters")

STATUS = PICK_PLACE_STATUS
DECIDED_BY = VALIDATED_TARGETS
REJECTED = REJECTED_TARGETS
DETECTED = DETECTED_OBJECTS
ANNOTATED = DETECTION_IMAGE
MASK = DETECTION_MASK


def scene_balls(truth: m.WorldObjects) -> m.PoseArray:
    """The spheres of the simulated world, with their states as labels: what lies in a container is in the box."""
    balls = [thing for thing in truth.objects if thing.shape == "sphere"]
    return m.PoseArray(
        header=truth.header, poses=[m.Pose(position=ball.pose.position) for ball in balls],
        ids=[ball.id for ball in balls],
        labels=["box" if ball.state == "contained" else ball.state for ball in balls],
    )


VIEWS = {SCENE_BALLS: scene_balls}
