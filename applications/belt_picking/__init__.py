"""Belt picking: take objects off a moving conveyor by what a camera sees, and put them into a container."""

from common.application import Application

APPLICATION = Application(
    topics="applications.belt_picking.topics:TOPICS",
    task="belt_picker",
    grasps=True,
    fills_containers=True,
)
