"""Sorting: take objects that were never seen before out of a tray, one at a time, into containers chosen by a rule."""

from common.application import Application, SimulationDouble

APPLICATION = Application(
    topics="applications.sorting.topics:TOPICS",
    task="sorter",
    grasps=True,
    fills_containers=True,
    figures="applications.sorting.figures:SortingFigures",
    page="applications.sorting.page:PAGE",
    verbs="applications.sorting.verbs:VERBS",
    double=SimulationDouble(
        module="applications.sorting.double",
        replaces=("depth_camera", "grasp_detector"),
        settings=("world.simulator=kinematic", "motion.velocity_scaling=0.6", "motion.acceleration_scaling=1.0"),
    ),
)
