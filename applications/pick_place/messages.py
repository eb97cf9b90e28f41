"""What the pick-and-place task says of itself."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import computed_field, model_validator

from common.messages.task import TaskStatus

TaskState = Literal["IDLE", "GRASPING", "PLACING", "HOMING", "DONE", "ERROR"]
SEED_NAMES = {"placed": "done", "targets": "total", "target": "subject"}  # on the wire beside those of every task


class PickPlaceStatus(TaskStatus):
    """State and counters of the pick-and-place task. `subject` is the track id of the object in work."""

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
        """Objects that were put into the container."""
        return self.done

    @computed_field  # type: ignore[prop-decorator]
    @property
    def targets(self) -> int:
        """Objects that the task has seen and may take or has taken."""
        return self.total

    @computed_field  # type: ignore[prop-decorator]
    @property
    def target(self) -> str:
        """Track id of the object in work."""
        return self.subject
