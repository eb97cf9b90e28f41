"""Messages and topics of pick and place."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import computed_field, model_validator

from common import messages as m
from common.application import ApplicationTopics
from common.messages.execution import TaskStatus
from common.topics import Topic

TaskState = Literal["IDLE", "GRASPING", "PLACING", "HOMING", "DONE", "ERROR"]
SEED_NAMES = {"placed": "done", "targets": "total", "target": "subject"}  # also on the wire


class PickPlaceStatus(TaskStatus):
    """State and counters of the pick-and-place task. `subject` is the track id of the current object."""

    state: TaskState = "IDLE"

    @model_validator(mode="before")
    @classmethod
    def _from_seed_names(cls, values: Any) -> Any:
        if not isinstance(values, dict):
            return values
        given = {name: value for name, value in values.items() if name not in SEED_NAMES}
        return {SEED_NAMES[name]: value for name, value in values.items() if name in SEED_NAMES} | given

    @computed_field  # type: ignore[prop-decorator]
    @property
    def placed(self) -> int:
        """Objects placed in the container."""
        return self.done

    @computed_field  # type: ignore[prop-decorator]
    @property
    def targets(self) -> int:
        """Objects that the task has seen and may take or has taken."""
        return self.total

    @computed_field  # type: ignore[prop-decorator]
    @property
    def target(self) -> str:
        """Track id of the current object."""
        return self.subject


SCENE_BALLS = Topic("scene_balls", m.PoseArray, "state", "the truth: where every ball is; simulated hardware only")
DETECTED_OBJECTS = Topic("detected_objects", m.MarkerArray, "stream",
                         "balls found in the picture, in world; also rejected red objects, with the reason as `text`")
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


def scene_balls(truth: m.WorldObjects) -> m.PoseArray:
    """Return the spheres of the simulated world with their states as labels; "box" for those in a container."""
    balls = [thing for thing in truth.objects if thing.shape == "sphere"]
    return m.PoseArray(
        header=truth.header, poses=[m.Pose(position=ball.pose.position) for ball in balls],
        ids=[ball.id for ball in balls],
        labels=["box" if ball.state == "contained" else ball.state for ball in balls],
    )


TOPICS = ApplicationTopics(
    declared=(SCENE_BALLS, DETECTED_OBJECTS, DETECTION_IMAGE, DETECTION_MASK, VALIDATED_TARGETS, REJECTED_TARGETS,
              WORKSPACE_MARKERS, PICK_PLACE_STATUS),
    status=PICK_PLACE_STATUS, decided_by=VALIDATED_TARGETS, rejected=REJECTED_TARGETS, detected=DETECTED_OBJECTS,
    of_arm=(VALIDATED_TARGETS, REJECTED_TARGETS, WORKSPACE_MARKERS),
    annotated=DETECTION_IMAGE, mask=DETECTION_MASK, truth_views={SCENE_BALLS: scene_balls},
)
