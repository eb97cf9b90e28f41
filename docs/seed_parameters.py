"""What became of every number of the seed system's configuration files.

Each row: seed name, seed value, frame, where ours lies (a path into the panda cell), what became of it, and what changes
when it is touched. The values of ours are read from the configuration when the document is made.
"""

from __future__ import annotations

from typing import NamedTuple


class SeedParameter(NamedTuple):
    """One number of the seed."""

    name: str
    value: str
    frame: str
    ours: tuple[str, ...]
    became: str
    effect: str


CONTROLLER = [
    SeedParameter("planning_attempts", "20", "", ("motion.planning_attempts",), "replaced",
                  "The best of so many sampled paths is kept. After the first few hardly any is shorter; each costs time."),
    SeedParameter("planning_time_s", "10.0 s", "", ("motion.planning_time", "services.smart_pick_place.planning_time"),
                  "kept",
                  "Wall time for one plan. The task asks for less, because it has another ball to try."),
    SeedParameter("velocity_scaling", "0.2", "", ("motion.velocity_scaling",), "kept",
                  "Fraction of the joints' speed limits: the arm is slower or faster everywhere."),
    SeedParameter("acceleration_scaling", "0.2", "", ("motion.acceleration_scaling",), "kept",
                  "Fraction of the joints' acceleration limits: starts and stops are softer or harder."),
    SeedParameter("cartesian_eef_step", "0.01 m", "", ("pipeline.cartesian.step",), "kept",
                  "Distance of the poses on a straight line for which joint positions are solved."),
    SeedParameter("cartesian_min_fraction", "0.95", "", ("pipeline.cartesian.min_fraction",), "kept",
                  "A line of which less is possible is refused and the next planner is asked."),
    SeedParameter("cartesian_speed_scale", "0.5", "", ("motion.cartesian_speed_scale",), "replaced",
                  "Stretches straight lines after planning. Not needed for safety here (lines are timed within the scaled "
                  "limits from the start), so the default is 1; 0.5 brings the seed's pace back."),
    SeedParameter("grasp_pos_tol", "0.04 m", "panda_link8", ("services.smart_pick_place.grasp_pos_tol",), "re-framed",
                  "Side of the box in which pre-grasp and lift may end. The descent always ends at the grasp itself."),
    SeedParameter("place_pos_tol", "0.06 m", "panda_link8", ("services.smart_pick_place.place_pos_tol",), "re-framed",
                  "Side of the box above the container in which a ball may be let go."),
    SeedParameter("orient_tol_rad", "0.25 rad", "panda_link8", ("services.smart_pick_place.orient_tol_rad",), "re-framed",
                  "Tilt of the tool that a sampled goal may have."),
    SeedParameter("orient_yaw_tol_rad", "3.14 rad", "panda_link8", ("services.smart_pick_place.orient_yaw_tol_rad",),
                  "re-framed",
                  "Turn of the tool that a sampled goal may have. The grasp itself has the yaw whose fingers clear the "
                  "neighbours."),
    SeedParameter("ball_x, ball_y", "7 pairs", "world", ("world.spots", "world.balls"), "kept",
                  "Where the balls really lie; read by the simulated hardware alone."),
    SeedParameter("ball_radius", "0.03 m", "", ("world.ball_radius",), "kept",
                  "Size of a ball for the picture, the detector, the planner and the fingers."),
    SeedParameter("ball_z", "0.025 m", "world", ("world.table_height",), "replaced",
                  "The seed's value puts the balls 5 mm into the table; ours rest on it: z is table height plus radius."),
    SeedParameter("approach_clearance", "0.20 m", "panda_link8", ("grasp.approach_clearance",), "re-framed",
                  "Pre-grasp above the grasp: higher is safer among tall things, lower is quicker."),
    SeedParameter("grasp_clearance", "0.04 m", "panda_link8", ("grasp.grasp_clearance",), "re-framed",
                  "Height of the grasp above the ball's centre. The seed's fingers close above the ball, on air."),
    SeedParameter("min_grasp_z", "0.16 m", "panda_link8", ("grasp.min_grasp_z",), "re-framed",
                  "The tool centre point never goes below this: too low scrapes the table."),
    SeedParameter("lift_height", "0.28 m", "panda_link8", ("grasp.lift_height",), "re-framed",
                  "Lift above the grasp before crossing to the box; must clear other balls."),
    SeedParameter("box_x, box_y", "0.55, 0.25 m", "world", ("world.container.x", "world.container.y"), "kept",
                  "Centre of the box: picture, planner, validator and task all follow."),
    SeedParameter("box_drop_z", "0.30 m", "panda_link8", ("grasp.drop_z",), "re-framed",
                  "Height of release above the box; must clear its walls and two layers of balls."),
    SeedParameter("home_x, home_y, home_z", "0.3, 0.0, 0.6 m", "panda_link8", ("robot.named_poses",), "replaced",
                  "Home is a joint pose with panda_link8 within 2 cm of that point, so that it is the same every time. "
                  "Only visited after a failure."),
    SeedParameter("(text) grace period", "8 s", "", ("services.smart_pick_place.grace",), "kept",
                  "How long the task waits before it ends when only balls are left that cannot be taken."),
    SeedParameter("(text) match radius", "0.08 m", "", ("services.scene_manager.match_radius",), "kept",
                  "A detection within this of a known ball is that ball. Wider than touching balls are apart, so matching "
                  "is one to one."),
    SeedParameter("(text) goal time-out", "60 s", "", ("services.smart_pick_place.goal_timeout",), "kept",
                  "A motion that takes longer is stopped and counts as a failure."),
]

VALIDATOR = [
    SeedParameter("min_height, max_height", "-0.05, 0.98 m", "world",
                  ("services.workspace_validator.min_height", "services.workspace_validator.max_height"), "kept",
                  "Objects lower or higher are rejected."),
    SeedParameter("min_reach, max_reach", "0.18, 0.82 m", "world",
                  ("services.workspace_validator.min_radius", "services.workspace_validator.max_radius"), "kept",
                  "Objects nearer to or further from the base axis are rejected."),
    SeedParameter("singularity column", "0.08 m", "world", ("services.workspace_validator.singularity_radius",), "kept",
                  "Objects this near to the base axis are rejected with that reason, before the least radius is tested."),
]

CAMERA = [
    SeedParameter("publish_rate", "10 Hz", "", ("services.camera_simulator.rate",), "kept", "Pictures in a second."),
    SeedParameter("image_width, image_height", "640, 480 px", "", ("world.camera.width", "world.camera.height"), "kept",
                  "Size of the picture."),
    SeedParameter("fx, fy", "520, 520 px", "", ("world.camera.fx", "world.camera.fy"), "kept",
                  "Focal length: larger sees less of the table in more detail."),
    SeedParameter("cx, cy", "320, 240 px", "", ("world.camera.cx", "world.camera.cy"), "kept",
                  "Where the optical axis meets the picture."),
    SeedParameter("cam_x, cam_y, cam_h", "0.40, 0.00, 0.80 m", "world", ("world.camera.position",), "kept",
                  "Where the camera hangs; tf, picture and detector follow."),
    SeedParameter("camera roll", "pi", "world", ("world.camera.rpy",), "replaced",
                  "The seed's pixel mapping is a mirror image that no rotation gives, and its tf is a third thing. Ours is "
                  "one rigid pose."),
    SeedParameter("min_contour_area_px", "400 px^2", "", ("services.vision_detector.min_contour_area_px",), "kept",
                  "Smaller blobs are noise."),
    SeedParameter("hsv_red_lo1, hsv_red_hi1", "[0, 120, 80], [10, 255, 255]", "",
                  ("services.vision_detector.hsv_red_lo1", "services.vision_detector.hsv_red_hi1"), "replaced",
                  "First window of hue, saturation and value: what counts as red. A value from 8 on: also in shadow."),
    SeedParameter("hsv_red_lo2, hsv_red_hi2", "[170, 120, 80], [180, 255, 255]", "",
                  ("services.vision_detector.hsv_red_lo2", "services.vision_detector.hsv_red_hi2"), "replaced",
                  "Second window: red lies on both sides of hue 0. Hue from 160 on: also in cold light."),
    SeedParameter("ball render radius", "0.03 m", "", ("world.ball_radius",), "kept",
                  "One number with the ball's size: a drawn ball is the sphere that the camera would see."),
]
