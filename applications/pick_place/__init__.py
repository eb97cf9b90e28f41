"""Pick and place: take objects that a camera detects from a table to a container."""

from common.application import Application, SimulationDouble

APPLICATION = Application(
    topics="applications.pick_place.topics:TOPICS",
    task="smart_pick_place",
    grasps=True,
    fills_containers=True,
    default=True,  # older cell files name no application; their tasks published `pick_place_status`
    figures="applications.pick_place.figures:PickPlaceFigures",
    page="applications.pick_place.page:PAGE",
    checks="applications.pick_place.cell_setup:CHECKS",
    fit_world="applications.pick_place.world_layout:fit_world",
    double=SimulationDouble(
        module="applications.pick_place.double",
        replaces=("camera_simulator", "vision_detector", "workspace_validator", "scene_manager"),
        settings=("world.count=1", "motion.velocity_scaling=0.6", "motion.acceleration_scaling=1.0"),
    ),
)
