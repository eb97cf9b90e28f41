"""Images, intrinsics and camera poses; detections compared with ground truth."""

import sys
from pathlib import Path

import cv2
import numpy as np

from zencell.blocking import Cell

with Cell(sys.argv[1]) if sys.argv[1:] else Cell.start("panda", overrides=["world.count=4"]) as cell:
    camera = cell.camera()  # the name is optional with one camera
    image, K, T_world_camera = camera.image(), camera.intrinsics(), camera.pose()
    print(f"{camera.name}: {image.shape[1]}x{image.shape[0]}, focal length {K[0, 0]:.0f} px, "
          f"{T_world_camera[2, 3]:.2f} m above the table")
    truth = cell.world.objects()  # simulation only; perception must not use it
    for found in cell.objects(least=len(truth)):
        p = found.pose.position
        off = min(np.hypot(p.x - each.pose.position.x, p.y - each.pose.position.y) for each in truth)
        point = np.linalg.inv(T_world_camera) @ [p.x, p.y, p.z, 1.0]  # in the camera frame
        u, v = (K @ point[:3])[:2] / point[2]
        cv2.circle(image, (round(u), round(v)), 25, (0, 255, 255), 2)
        cv2.putText(image, found.id, (round(u) + 28, round(v)), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 255, 255), 1)
        print(f"{found.id} at {p.x:.3f}, {p.y:.3f} m, {1e3 * off:.1f} mm off")
    cv2.imwrite("look.png", image)
    print(f"{Path('look.png').absolute()} was written")
