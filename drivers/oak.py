"""A Luxonis OAK-D, by the maker's package `depthai` (version 3, extra `cameras`): the camera computes depth."""

from __future__ import annotations

import contextlib
from datetime import timedelta
from typing import Any

import numpy as np
from pydantic import Field

from common.config import Parameters
from common.perception.depth_drivers import CameraLost, Intrinsics, RgbdFrame, import_sdk

TIMEOUT = timedelta(seconds=2)  # without a frame, after which the camera is lost
STEREO_SIZE = (640, 400)  # [px] of the stereo pair
MILLIMETRE = np.float32(1e-3)  # [m] of one step of depth


class Options(Parameters):
    """Identity of the camera, and its rate."""

    device: str = Field("", description="id, or address in the network; empty: the first one found")
    fps: float = Field(30.0, ge=1, le=60, description="frame rate [Hz]")
    subpixel: bool = Field(True, description="finer steps of depth, at a higher load of the camera")


class Oak:
    """A camera whose pipeline runs. Colour images are undistorted, and depth is aligned to them."""

    def __init__(self, dai: Any, pipeline: Any, queue: Any) -> None:
        """Wait for the first frame, which has the intrinsics.

        Raises:
            CameraLost: none arrives.
        """
        self._dai, self._pipeline, self._queue = dai, pipeline, queue
        try:
            frame = self._next()["rgb"]
        except CameraLost:
            self.close()
            raise
        k = frame.getTransformation().getIntrinsicMatrix()
        self.lens = Intrinsics(frame.getWidth(), frame.getHeight(), k[0][0], k[1][1], k[0][2], k[1][2])

    def _next(self) -> Any:
        try:
            group = self._queue.get(TIMEOUT)
        except RuntimeError as error:  # unplugged: the queue is closed
            raise CameraLost(str(error)) from None
        if group is None:
            raise CameraLost(f"no frame within {TIMEOUT.total_seconds():g} s")
        return group

    def read(self) -> RgbdFrame:
        """Wait for the next frame, with depth and colour of the same instant."""
        group = self._next()
        color = group["rgb"]
        steps = np.asanyarray(group["depth"].getFrame())
        metres = np.where(steps > 0, steps * MILLIMETRE, np.float32(np.nan)).astype(np.float32)
        age = (self._dai.Clock.now() - color.getTimestamp()).total_seconds()  # both by the clock of this host
        return RgbdFrame(np.array(color.getCvFrame()), metres, max(0.0, age))

    def close(self) -> None:
        """Stop the pipeline."""
        with contextlib.suppress(RuntimeError):  # it is lost already
            self._pipeline.stop()


def open_camera(options: Options, size: tuple[int, int], rate: float) -> Oak:
    """Open the camera: see `common.perception.depth_drivers`."""
    dai = import_sdk("oak", "depthai")
    try:
        device = dai.Device(dai.DeviceInfo(options.device)) if options.device else dai.Device()
    except RuntimeError as error:  # none is plugged in, or another process has it
        raise CameraLost(str(error)) from None
    try:
        pipeline = dai.Pipeline(device)
        queue = _connected(dai, pipeline, device, options, size)
        pipeline.start()
    except RuntimeError as error:  # no such mode, or it was unplugged
        device.close()
        raise CameraLost(f"{size[0]}x{size[1]} at {options.fps:g} Hz: {error}") from None
    return Oak(dai, pipeline, queue)


def _connected(dai: Any, pipeline: Any, device: Any, options: Options, size: tuple[int, int]) -> Any:
    """Build the pipeline; return its queue of synchronized `rgb` and `depth`."""
    socket, node = dai.CameraBoardSocket, dai.node
    color = pipeline.create(node.Camera).build(socket.CAM_A)
    image = color.requestOutput(size, type=dai.ImgFrame.Type.BGR888i, fps=options.fps, enableUndistortion=True)
    sides = [pipeline.create(node.Camera).build(side).requestOutput(STEREO_SIZE, fps=options.fps)
             for side in (socket.CAM_B, socket.CAM_C)]
    stereo = pipeline.create(node.StereoDepth).build(*sides, presetMode=node.StereoDepth.PresetMode.DEFAULT)
    stereo.setLeftRightCheck(True)
    stereo.setSubpixel(options.subpixel)
    synchronized = pipeline.create(node.Sync)
    synchronized.setSyncThreshold(timedelta(seconds=0.5 / options.fps))
    image.link(synchronized.inputs["rgb"])
    if device.getPlatform() == dai.Platform.RVC4:  # its stereo node cannot align
        align = pipeline.create(node.ImageAlign)
        stereo.depth.link(align.input)
        image.link(align.inputAlignTo)
        align.outputAligned.link(synchronized.inputs["depth"])
    else:
        image.link(stereo.inputAlignTo)
        stereo.depth.link(synchronized.inputs["depth"])
    return synchronized.out.createOutputQueue(maxSize=1, blocking=False)
