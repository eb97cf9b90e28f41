"""Images of a board, rendered with a known camera and lens."""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from common.perception.camera_file import CameraFile
from common.perception.pinhole import Pinhole
from common.robot.transforms import invert, rpy_to_matrix, transform
from common.sim.rendering import RIM_WIDTH
from tests.common.sim.spheres import draw_spheres
from tools.calibration.board import Board, BoardOptions

FINER = 2  # rays along each side of a pixel


@dataclass(frozen=True)
class Lens:
    """The true intrinsics."""

    fx: float = 533.0
    fy: float = 529.0
    cx: float = 326.5
    cy: float = 234.2
    d: tuple = (-0.21, 0.09, 0.0012, -0.0008)
    width: int = 640
    height: int = 480

    @property
    def k(self):
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def camera(self):
        return CameraFile(width=self.width, height=self.height, fx=self.fx, fy=self.fy, cx=self.cx, cy=self.cy,
                          d=list(self.d))

    def project(self, T_camera_board, points):
        """Return the pixels of points (n, 3) on a board."""
        rotation = cv2.Rodrigues(T_camera_board[:3, :3])[0]
        return cv2.projectPoints(points, rotation, T_camera_board[:3, 3], self.k, np.array(self.d))[0][:, 0]

    def pixels(self):
        """Return each pixel in FINER x FINER parts: (height * FINER, width * FINER, 2)."""
        part = (np.arange(FINER) + 0.5) / FINER - 0.5
        u = (np.arange(self.width)[:, None] + part).ravel()
        v = (np.arange(self.height)[:, None] + part).ravel()
        return np.stack(np.meshgrid(u, v), axis=-1)

    @cache  # noqa: B019 -- a few lenses, and they live as long as the tests
    def rays(self):
        """Return x and y of the ray of each part of a pixel, at z = 1: (height * FINER, width * FINER, 2)."""
        pixels = self.pixels()
        criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-10)
        rays = cv2.undistortPoints(pixels.reshape(-1, 1, 2), self.k, np.array(self.d), criteria=criteria)
        return rays.reshape(pixels.shape)


def render(board: Board, lens: Lens, T_camera_board, *, blur=0.5, noise=2.0, seed=0, background=110):
    """Return the bgr8 image of a board at a pose in the optical frame."""
    page, density, margin = printed(board)
    parts = np.full((lens.height * FINER, lens.width * FINER), background, np.float32)
    w, h = board.size
    corners = np.array([[-margin, -margin, 0], [w + margin, -margin, 0], [w + margin, h + margin, 0],
                        [-margin, h + margin, 0]])
    outline = lens.project(T_camera_board, corners)
    limit = np.array([lens.width, lens.height])
    low = (np.clip(outline.min(axis=0) - 12, 0, limit) * FINER).astype(int)
    high = (np.clip(outline.max(axis=0) + 12, 0, limit) * FINER).astype(int)
    where = slice(low[1], high[1]), slice(low[0], high[0])
    rays = lens.rays()[where]
    T = invert(T_camera_board)
    origin, d = T[:3, 3], rays @ T[:3, :2].T + T[:3, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -origin[2] / d[..., 2]
        x, y = origin[0] + t * d[..., 0], origin[1] + t * d[..., 1]
    u = np.where(t > 0, (x + margin) * density - 0.5, -1e4).astype(np.float32)
    v = np.where(t > 0, (board.size[1] + margin - y) * density - 0.5, -1e4).astype(np.float32)
    # A part of a pixel sees all of its square: the page is smeared by as much beforehand.
    smeared = cv2.GaussianBlur(page, (0, 0), 0.5 * density * T_camera_board[2, 3] / lens.fx / FINER)
    parts[where] = cv2.remap(smeared, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=background)
    return develop(parts, blur, noise, seed, lens)


@cache
def printed(board: Board):
    """Return the page of a board, coarser than a printer's, its density [px/m] and its upper left margin [m]."""
    page, density = board.page()
    margin = (page.shape[1] / density - board.size[0]) / 2
    height, width = page.shape
    page = np.pad(page, ((0, -height % 4), (0, -width % 4)), constant_values=255)
    coarse = cv2.resize(page, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    return coarse.astype(np.float32), density / 4, margin


def develop(parts, blur, noise, seed, lens):
    """Return an image from parts of pixels, with blur [px] and noise."""
    picture = cv2.resize(parts, (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    picture = cv2.GaussianBlur(picture, (0, 0), blur) if blur else picture
    picture = 20 + 0.8 * picture  # neither black nor white is ever quite so
    picture = picture + np.random.default_rng(seed).normal(0, noise, picture.shape)
    grey = np.clip(np.round(picture), 0, 255).astype(np.uint8)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR) if grey.ndim == 2 else grey


def facing(board: Board, x, y, z, tilt_x=0.0, tilt_y=0.0, turn=0.0):
    """Return T_camera_board with the board's center at (x, y, z) [m] of the optical frame, tilted and turned [rad]."""
    R = rpy_to_matrix(np.pi, 0, 0) @ rpy_to_matrix(tilt_x, tilt_y, turn)
    middle = np.array([board.size[0] / 2, board.size[1] / 2, 0])
    return transform(R, np.array([x, y, z]) - R @ middle)


def many_poses(board: Board, count, seed=1, z=(0.45, 0.75)):
    """Return poses all over the image, with tilts to every side."""
    rng = np.random.default_rng(seed)
    poses = []
    for k in range(count):
        depth = rng.uniform(*z)
        angle = 2.4 * k
        x, y = 0.42 * depth * rng.uniform(0.2, 1.2) * np.array([np.cos(angle), 0.75 * np.sin(angle)])
        tilt = rng.uniform(0.25, 0.65)
        poses.append(facing(board, x, y, depth, tilt * np.sin(1.7 * k), tilt * np.cos(1.7 * k), rng.uniform(-0.6, 0.6)))
    return poses


def through(lens: Lens, T_world_camera, surroundings, balls, *, noise=2.0, seed=0):
    """Return the bgr8 image of balls (n, 3) in world on the table through the lens."""
    finer, border = 3, 200  # [px] beyond the image, which the lens may pull in
    k = finer * lens.k
    pinhole = Pinhole(k[0, 0], k[1, 1], finer * (lens.cx + border + 0.5) - 0.5, finer * (lens.cy + border + 0.5) - 0.5,
                      finer * (lens.width + 2 * border), finer * (lens.height + 2 * border), T_world_camera)
    straight = draw_spheres(balls, pinhole, surroundings, rim_width=finer * RIM_WIDTH)
    rays = lens.rays()
    u, v = rays[..., 0] * pinhole.fx + pinhole.cx, rays[..., 1] * pinhole.fy + pinhole.cy
    smeared = cv2.GaussianBlur(straight.astype(np.float32), (0, 0), 0.7)
    parts = cv2.remap(smeared, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    return develop(parts, 0, noise, seed, lens)


BOARD = Board(BoardOptions())
