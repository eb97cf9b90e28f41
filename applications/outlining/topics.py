"""Keys of outlining."""

from __future__ import annotations

from applications.outlining.messages import (
    Contours,
    OutlinePoints,
    OutlineSelect,
    OutlineSelection,
    OutlineStatus,
)
from common import messages as m
from common.topics import Request, Topic

CONTOURS = Topic("contours", Contours, "state", "contours of the picture and the chosen one")
CONTOUR_IMAGE = Topic("contour_image", m.Image, "state", "the picture with labelled contours")
CONTOUR_POINTS = Topic("contour_points", OutlinePoints, "state", "outline of the chosen object's top face in world")
CONTOUR_PATH = Topic("contour_path", OutlinePoints, "state", "the same, cleared of duplicates")
OUTLINE_STATUS = Topic("outline_status", OutlineStatus, "state", "state and figures")
OUTLINE_SELECT = Request("outline/select", OutlineSelect, OutlineSelection, "choose the object to outline")

STATUS = OUTLINE_STATUS
DECIDED_BY = CONTOUR_PATH
ANNOTATED = CONTOUR_IMAGE
