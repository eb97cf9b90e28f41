"""Sorting: take objects that were never seen before out of a tray, one at a time, into containers chosen by a rule."""

from common.application import Application

APPLICATION = Application(
    topics="applications.sorting.topics:TOPICS",
    task="sorter",
    grasps=True,
    fills_containers=True,
    page="applications.sorting.page:PAGE",
)
