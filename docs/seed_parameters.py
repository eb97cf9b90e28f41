"""Every number of the seed system's configuration files, and the corresponding parameter of this project.

Our values are read from the panda cell when the document is generated.
"""

from __future__ import annotations

from typing import NamedTuple


class SeedParameter(NamedTuple):
    """One number of the seed, the paths of our parameters in the panda cell, and the effect of changing it."""

    name: str
    value: str
    frame: str
    ours: tuple[str, ...]
    status: str
    effect: str


CONTROLLER = [
    SeedParameter("planning_attempts", "20", "", ("motion.planning_attempts",), "replaced",
                  "The best of this many sampled paths is used. After the first few, further ones are hardly shorter, and each costs time."),
    SeedParameter("planning_time_s", "10.0 s", "", ("motion.planning_time", "services.smart_pick_place.planning_time"),
                  "unchanged",
                  "Wall time for one plan. The task requests less, because it can try another ball."),
    SeedParameter("velocity_scaling", "0.2", "", ("motion.velocity_scaling",), "unchanged",
                  "Fraction of the joints' velocity limits."),
    SeedParameter("acceleration_scaling", "0.2", "", ("motion.acceleration_scaling",), "unchanged",
                  "Fraction of the joints' acceleration limits."),
    SeedParameter("cartesian_eef_step", "0.01 m", "", ("pipeline.cartesian.step",), "unchanged",
                  "Distance between the poses on a straight line for which inverse kinematics is solved."),
    SeedParameter("cartesian_min_fraction", "0.95", "", ("pipeline.cartesian.min_fraction",), "unchanged",
                  "If a smaller share of a line is possible, the line is rejected and the next planner is tried."),
    SeedParameter("cartesian_speed_scale", "0.5", "", ("motion.cartesian_speed_scale",), "replaced",
                  "Stretches straight lines after planning. Not needed for safety here (lines are timed within the scaled "
                  "limits from the start), so the default is 1; 0.5 restores the seed's speed."),
    SeedParameter("grasp_pos_tol", "0.04 m", "panda_link8", ("services.smart_pick_place.grasp_pos_tol",), "re-framed",
                  "Side of the goal region of pre-grasp and lift. The descent always ends at the exact grasp."),
    SeedParameter("place_pos_tol", "0.06 m", "panda_link8", ("services.smart_pick_place.place_pos_tol",), "re-framed",
                  "Side of the region above the container in which a ball may be released."),
    SeedParameter("orient_tol_rad", "0.25 rad", "panda_link8", ("services.smart_pick_place.orient_tol_rad",), "re-framed",
                  "Allowed tilt of the tool in sampled goals."),
    SeedParameter("orient_yaw_tol_rad", "3.14 rad", "panda_link8", ("services.smart_pick_place.orient_yaw_tol_rad",),
                  "re-framed",
                  "Allowed yaw of the tool in sampled goals. The grasp itself uses a yaw at which the fingers clear the "
                  "neighbors."),
    SeedParameter("ball_x, ball_y", "7 pairs", "world", ("world.spots", "world.balls"), "unchanged",
                  "True ball positions; only the simulated hardware reads them."),
    SeedParameter("ball_radius", "0.03 m", "", ("world.ball_radius",), "unchanged",
                  "Size of a ball for rendering, detection, planning and grasping."),
    SeedParameter("ball_z", "0.025 m", "world", ("world.table_height",), "replaced",
                  "The seed's value puts the balls 5 mm into the table; ours lie on it: z is table height plus radius."),
    SeedParameter("approach_clearance", "0.20 m", "panda_link8", ("grasp.approach_clearance",), "re-framed",
                  "Height of the pre-grasp above the grasp: higher is safer among tall objects, lower is faster."),
    SeedParameter("grasp_clearance", "0.04 m", "panda_link8", ("grasp.grasp_clearance",), "re-framed",
                  "Height of the grasp above the ball's center. The seed's fingers close above the ball."),
    SeedParameter("min_grasp_z", "0.16 m", "panda_link8", ("grasp.min_grasp_z",), "re-framed",
                  "Lowest height of the tool center point: a lower one scrapes the table."),
    SeedParameter("lift_height", "0.28 m", "panda_link8", ("grasp.lift_height",), "re-framed",
                  "Lift above the grasp before the motion to the box; must clear other balls."),
    SeedParameter("box_x, box_y", "0.55, 0.25 m", "world", ("world.container.x", "world.container.y"), "unchanged",
                  "Center of the box for rendering, planner, validator and task."),
    SeedParameter("box_drop_z", "0.30 m", "panda_link8", ("grasp.drop_z",), "re-framed",
                  "Height of the release above the box; must clear its walls and two layers of balls."),
    SeedParameter("home_x, home_y, home_z", "0.3, 0.0, 0.6 m", "panda_link8", ("robot.named_poses",), "replaced",
                  "Home is a joint pose with panda_link8 within 2 cm of that point, so that it is always the same. "
                  "The arm returns there only after a failure."),
    SeedParameter("(text) grace period", "8 s", "", ("services.smart_pick_place.grace",), "unchanged",
                  "Time until the task ends when only unreachable balls are left."),
    SeedParameter("(text) match radius", "0.08 m", "", ("services.scene_manager.match_radius",), "unchanged",
                  "A detection within this distance of a known ball is that ball. It exceeds the distance of touching balls, so "
                  "matching is one to one."),
    SeedParameter("(text) goal time-out", "60 s", "", ("services.smart_pick_place.goal_timeout",), "unchanged",
                  "A longer motion is stopped and counts as a failure."),
]

VALIDATOR = [
    SeedParameter("min_height, max_height", "-0.05, 0.98 m", "world",
                  ("services.workspace_validator.min_height", "services.workspace_validator.max_height"), "unchanged",
                  "Objects lower or higher are rejected."),
    SeedParameter("min_reach, max_reach", "0.18, 0.82 m", "world",
                  ("services.workspace_validator.min_radius", "services.workspace_validator.max_radius"), "unchanged",
                  "Objects closer to or farther from the base axis are rejected."),
    SeedParameter("singularity column", "0.08 m", "world", ("services.workspace_validator.singularity_radius",), "unchanged",
                  "Objects this close to the base axis are rejected with that reason, before the minimum radius is checked."),
]

CAMERA = [
    SeedParameter("publish_rate", "10 Hz", "", ("services.camera_simulator.rate",), "unchanged", "Images per second."),
    SeedParameter("image_width, image_height", "640, 480 px", "", ("world.camera.width", "world.camera.height"), "unchanged",
                  "Size of the image."),
    SeedParameter("fx, fy", "520, 520 px", "", ("world.camera.fx", "world.camera.fy"), "unchanged",
                  "Focal length: a larger one shows less of the table in more detail."),
    SeedParameter("cx, cy", "320, 240 px", "", ("world.camera.cx", "world.camera.cy"), "unchanged",
                  "Principal point."),
    SeedParameter("cam_x, cam_y, cam_h", "0.40, 0.00, 0.80 m", "world", ("world.camera.position",), "unchanged",
                  "Camera position for tf, rendering and detector."),
    SeedParameter("camera roll", "pi", "world", ("world.camera.rpy",), "replaced",
                  "The seed's pixel mapping is a mirror image, which no rotation produces, and its tf differs again. Ours is "
                  "one rigid pose."),
    SeedParameter("min_contour_area_px", "400 px^2", "", ("services.vision_detector.min_contour_area_px",), "unchanged",
                  "Smaller blobs are noise."),
    SeedParameter("hsv_red_lo1, hsv_red_hi1", "[0, 120, 80], [10, 255, 255]", "",
                  ("services.vision_detector.hsv_red_lo1", "services.vision_detector.hsv_red_hi1"), "replaced",
                  "First range of hue, saturation and value that counts as red. Values from 8: also in shadow."),
    SeedParameter("hsv_red_lo2, hsv_red_hi2", "[170, 120, 80], [180, 255, 255]", "",
                  ("services.vision_detector.hsv_red_lo2", "services.vision_detector.hsv_red_hi2"), "replaced",
                  "Second range: red is on both sides of hue 0. Hue from 160: also in cold light."),
    SeedParameter("ball render radius", "0.03 m", "", ("world.ball_radius",), "unchanged",
                  "The same number as the ball's size: a ball is rendered as the sphere that a camera would see."),
]
