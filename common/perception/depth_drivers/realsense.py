"""An Intel RealSense of the D400 series, with the maker's package `pyrealsense2`."""

from __future__ import annotations

import contextlib
import time
from typing import Any, Literal

import numpy as np
from pydantic import Field

from common.config import Parameters
from common.errors import ConfigError
from common.perception.depth_sources import CameraGone, Lens, Shot, maker_of

PATIENCE = 1000  # [ms] without a frame after which the camera is gone


class Options(Parameters):
    """Which camera it is, and how its pictures are made."""

    serial: str = Field("", description="of the camera, as `rs-enumerate-devices -s` prints it; empty: the first")
    fps: int = Field(30, ge=1, le=90, description="frames per second it makes: it knows 6, 15, 30, 60 and 90 [Hz]")
    align: Literal["color", "depth"] = Field("color", description="the picture that the other one is made to fit")


class RealSense:
    """A camera whose pipeline runs."""

    def __init__(self, rs: Any, pipeline: Any, profile: Any, align: str) -> None:
        """Take a pipeline that was started.

        Raises:
            ConfigError: the lens of the picture that is kept as it is has distortion.
        """
        self._rs, self._pipeline = rs, pipeline
        self._scale = float(profile.get_device().first_depth_sensor().get_depth_scale())  # [m] of one step of z16
        stream = getattr(rs.stream, align)
        self._align = rs.align(stream)
        i = profile.get_stream(stream).as_video_stream_profile().get_intrinsics()
        if any(i.coeffs):
            raise ConfigError("options.align", align,
                              f"has distortion {list(i.coeffs)}, which depth cannot have: depth")
        self.lens = Lens(i.width, i.height, i.fx, i.fy, i.ppx, i.ppy)

    def read(self) -> Shot:
        """The next shot, depth and colour of the same instant."""
        while True:
            try:
                frames = self._align.process(self._pipeline.wait_for_frames(PATIENCE))
            except RuntimeError as error:  # unplugged, or it hangs
                raise CameraGone(str(error)) from None
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
            if not depth or not color:
                continue  # the first frames may lack one of them
            steps = np.asanyarray(depth.get_data())
            metres = np.where(steps > 0, steps * np.float32(self._scale), np.float32(np.nan)).astype(np.float32)
            pixels = np.array(color.get_data())  # a copy: what it gives is its own memory
            age = 0.0
            if color.get_frame_timestamp_domain() == self._rs.timestamp_domain.global_time:  # of this machine [ms]
                age = max(0.0, time.time() - color.get_timestamp() * 1e-3)
            return Shot(pixels, metres, age)

    def close(self) -> None:
        """Stop it."""
        with contextlib.suppress(RuntimeError):  # it is gone already
            self._pipeline.stop()


def open_camera(options: Options, size: tuple[int, int], rate: float) -> RealSense:
    """The camera: see `common.perception.depth_sources`."""
    rs = maker_of("realsense", "pyrealsense2")
    there = [device.get_info(rs.camera_info.serial_number) for device in rs.context().query_devices()]
    if not there:
        raise CameraGone("no RealSense is plugged in")
    if options.serial and options.serial not in there:
        raise CameraGone(f"RealSense {options.serial} is not plugged in; there are: {', '.join(there)}")
    width, height = size
    config, pipeline = rs.config(), rs.pipeline()  # a new one each time: one that lost its camera stays without
    config.enable_device(options.serial or there[0])
    config.enable_stream(rs.stream.depth, width, height, rs.format.z16, options.fps)
    config.enable_stream(rs.stream.color, width, height, rs.format.bgr8, options.fps)
    try:
        return RealSense(rs, pipeline, pipeline.start(config), options.align)
    except RuntimeError as error:  # no such mode, or somebody else has it
        raise CameraGone(f"{width}x{height} at {options.fps} Hz: {error}") from None
