"""Stand-ins for the Python packages of depth cameras, with as much of their interfaces as the drivers use."""

from __future__ import annotations

import time
from datetime import timedelta
from types import ModuleType
from typing import Any, cast
from unittest.mock import MagicMock

import numpy as np

from common.perception.depth_drivers import RgbdFrame

WIDTH, HEIGHT = 64, 48
SCALE = 0.00025  # [m] of one step of the RealSense: other than the usual one
STEPS = 4000
LENS = (40.0, 40.0, 31.5, 23.5)  # fx, fy, cx, cy of the OAK [px]


class FakeRealSense:
    """A RealSense, which may be unplugged; its color lens is not its depth lens.

    Depth lacks one column; the first frames lack color. `shot` replaces both images.
    """

    def __init__(self) -> None:
        self.plugged, self.coeffs, self.opened, self.stopped, self.count = True, [0.0] * 5, 0, 0, 0
        self.streams: dict[str, tuple[Any, ...]] = {}
        self.shot: RgbdFrame | None = None
        self.lenses = {"color": (40.0, 41.0, 31.0, 23.0), "depth": (35.0, 35.0, 30.0, 22.0)}

    def start(self, config: Any) -> Any:
        self.streams = {call.args[0]: call.args[1:] for call in config.enable_stream.call_args_list[-2:]}
        self.streams["device"] = config.enable_device.call_args.args
        if self.streams["color"][0] != WIDTH:
            raise RuntimeError("Couldn't resolve requests")
        self.opened, self.count = self.opened + 1, 0
        profile = MagicMock()
        profile.get_device().is_playback.return_value = False
        profile.get_device().first_depth_sensor().get_depth_scale.return_value = SCALE
        profile.get_stream.side_effect = self.stream
        return profile

    def stream(self, name: str) -> Any:
        fx, fy, ppx, ppy = self.lenses[name]
        stream = MagicMock()
        stream.format.return_value = "bgr8"
        stream.as_video_stream_profile().get_intrinsics.return_value = MagicMock(
            width=WIDTH, height=HEIGHT, fx=fx, fy=fy, ppx=ppx, ppy=ppy,
            coeffs=self.coeffs if name == "color" else [0.0] * 5)
        return stream

    def require_plugged(self) -> None:
        if not self.plugged:
            raise RuntimeError("Frame didn't arrive within 1000")

    def wait_for_frames(self, timeout: int) -> None:
        self.require_plugged()
        time.sleep(0.002)
        self.count += 1

    def stop(self) -> None:
        self.stopped += 1
        self.require_plugged()

    def aligned(self, _: Any) -> Any:
        """Return depth and color; only this depth, which is aligned, has the right values."""
        steps = np.full((HEIGHT, WIDTH), STEPS, np.uint16)
        steps[:, 5] = 0
        color = np.full((HEIGHT, WIDTH, 3), (10, 20, 200), np.uint8)
        if self.shot is not None:
            steps, color = np.rint(np.nan_to_num(self.shot.depth) / SCALE).astype(np.uint16), self.shot.colour
        frames = MagicMock()
        frames.get_depth_frame().get_data.return_value = steps
        frames.get_color_frame().get_data.return_value = color
        frames.get_color_frame().get_timestamp.return_value = 1e3 * (time.time() - 0.2)
        frames.get_color_frame().get_frame_timestamp_domain.return_value = "global"
        if self.count == 1:
            frames.get_color_frame.return_value = None
        return frames

    def module(self) -> ModuleType:
        """Return pyrealsense2."""
        rs, device = MagicMock(), MagicMock()
        rs.stream.color, rs.stream.depth = "color", "depth"
        rs.format.z16, rs.format.bgr8, rs.format.rgb8 = "z16", "bgr8", "rgb8"
        rs.timestamp_domain.global_time, rs.camera_info.serial_number = "global", "serial"
        device.get_info.side_effect = {"serial": "0123"}.get
        rs.context().query_devices.side_effect = lambda: [device] if self.plugged else []
        pipeline = rs.pipeline.return_value
        pipeline.start.side_effect, pipeline.stop.side_effect = self.start, self.stop
        pipeline.wait_for_frames.side_effect = self.wait_for_frames
        rs.align.return_value.process.side_effect = self.aligned
        return cast(ModuleType, rs)


class FakeOak:
    """An OAK, which may be unplugged, and whose images are a shot."""

    def __init__(self, shot: RgbdFrame, platform: str = "RVC2") -> None:
        self.shot, self.platform, self.plugged, self.closed, self.aligned_by = shot, platform, True, 0, ""
        self.outputs: dict[str, Any] = {}

    def output(self, name: str) -> Any:
        def link(to: Any) -> None:
            if to in ("stereo", "align"):
                self.aligned_by = to

        return MagicMock(socket=name, link=link)

    def request_output(self, socket: str, *size: Any, **how: Any) -> Any:
        self.outputs[socket] = (*size, how)
        return self.output(socket)

    def camera(self) -> Any:
        camera = MagicMock()
        camera.build.side_effect = lambda socket: MagicMock(
            requestOutput=lambda *size, **how: self.request_output(socket, *size, **how))
        return camera

    def stereo(self) -> Any:
        def build(left: Any, right: Any, presetMode: str) -> Any:  # noqa: N803
            assert (left.socket, right.socket) == ("left", "right")
            return MagicMock(inputAlignTo="stereo", depth=self.output("depth"))

        return MagicMock(build=build)

    def device(self, *which: Any) -> Any:
        if not self.plugged:
            raise RuntimeError("No available devices")
        return MagicMock(getPlatform=lambda: self.platform)

    def get(self, timeout: timedelta) -> Any:
        if not self.plugged:
            raise RuntimeError("queue was closed")
        time.sleep(0.002)
        group = {"rgb": MagicMock(), "depth": MagicMock()}
        k = [[LENS[0], 0, LENS[2]], [0, LENS[1], LENS[3]], [0, 0, 1]]
        group["rgb"].getTransformation().getIntrinsicMatrix.return_value = k
        group["rgb"].getWidth.return_value, group["rgb"].getHeight.return_value = WIDTH, HEIGHT
        group["rgb"].getCvFrame.return_value = self.shot.colour
        group["rgb"].getTimestamp.return_value = timedelta(seconds=10.0)
        steps = np.rint(np.nan_to_num(self.shot.depth) * 1000).astype(np.uint16)
        group["depth"].getFrame.return_value = steps
        return group

    def stop(self) -> None:
        self.closed += 1

    def module(self) -> ModuleType:
        """Return depthai."""
        dai = MagicMock(Device=self.device)
        socket = dai.CameraBoardSocket
        socket.CAM_A, socket.CAM_B, socket.CAM_C = "color", "left", "right"
        dai.Platform.RVC4, dai.ImgFrame.Type.BGR888i = "RVC4", "bgr"
        dai.Clock.now.return_value = timedelta(seconds=10.1)
        dai.node.Camera, dai.node.StereoDepth.side_effect = self.camera, self.stereo
        dai.node.ImageAlign.return_value = MagicMock(inputAlignTo="align", outputAligned=self.output("aligned"))
        dai.node.Sync.return_value.out.createOutputQueue.return_value.get = self.get
        pipeline = dai.Pipeline.return_value
        pipeline.create, pipeline.stop = lambda node: node(), self.stop
        return cast(ModuleType, dai)
