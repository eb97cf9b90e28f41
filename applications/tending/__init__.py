"""Machine tending: parts from a tray into a fixture, clamp, machine, and onto a pallet."""

from common.application import Application

APPLICATION = Application(
    topics="applications.tending.topics:TOPICS",
    task="tender",
    grasps=True,
    figures="applications.tending.figures:TendingFigures",
)
