"""Outlining: trace the outline of an object that a depth camera detects."""

from common.application import Application, SimulationDouble

APPLICATION = Application(
    topics="applications.outlining.topics:TOPICS",
    task="contour_tracer",
    figures="applications.outlining.recording:OutlineFigures",
    foxglove="applications.outlining.recording:FOXGLOVE",
    page="applications.outlining.page:PAGE",
    verbs="applications.outlining.verbs:VERBS",
    double=SimulationDouble(
        module="applications.outlining.double",
        replaces=("depth_camera", "contour_detector", "pixel_to_world", "duplicate_remover", "outline_scene"),
        settings=("motion.velocity_scaling=0.6", "motion.acceleration_scaling=1.0"),
    ),
)
