"""Names and numbers of a description, checked before C++ code reads it, which prints and accepts any finite number."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET

import numpy as np

from common.errors import ConfigError

LARGEST = 1e6  # number without another bound
FARTHEST = 100.0  # [m or rad] of an origin in its link
UNLIMITED = sys.float_info.max  # what makers write as effort, speed and range without a limit is below it
SHORTEST = 1e-6  # axis
MOVING = ("revolute", "continuous", "prismatic")
_KINDS = (*MOVING, "fixed", "floating", "planar")


def numbers(
    element: ET.Element | None, name: str, count: int, default: str | None = None, bound: float = LARGEST
) -> tuple[float, ...]:
    """Return the numbers of an attribute; those of `default` without the element or the attribute.

    Raises:
        ValueError: there are more or fewer, one is none or not below the bound, or the attribute is missing.
    """
    text = element.get(name, default) if element is not None else default
    tag = element.tag if element is not None else name
    if text is None:
        raise ValueError(f"<{tag}> has no {name}")
    try:
        values = tuple(float(value) for value in text.split())
    except ValueError:
        values = ()
    if len(values) != count or not all(abs(value) < bound for value in values) or "_" in text or not text.isascii():
        wanted = "a number" if count == 1 else f"{count} numbers"
        wanted += " in m or rad" if bound == FARTHEST else ""
        raise ValueError(f"{name} of <{tag}> is {text!r}, but must be {wanted} below {bound:g}")
    return values


def check_values(field: str, source: str, root: ET.Element) -> None:
    """Check the names of links and joints, and all numbers outside their shapes.

    Raises:
        ConfigError: names the link or joint, and the value.
    """
    for tag, check in (("link", _check_link), ("joint", _check_joint)):
        seen: set[str] = set()
        for element in root.findall(tag):
            name = element.get("name", "")
            if not name.strip() or name in seen:
                fault = f"more than one {tag} called {name!r}" if name.strip() else f"a {tag} without a name"
                raise ConfigError(field, source, f"has {fault}")
            seen.add(name)
            try:
                check(element)
            except ValueError as error:
                raise ConfigError(field, source, f"has a {tag} {name!r} that is unusable: {error}") from None


def _check_link(link: ET.Element) -> None:
    for inertial in link.findall("inertial"):
        _check_origin(inertial)
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        if mass is not None:
            _check_positive(mass, "value", LARGEST)
        for axes in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"):
            numbers(inertia, axes, 1, "0")


def _check_joint(joint: ET.Element) -> None:
    kind, axis, limit, mimic = joint.get("type"), joint.find("axis"), joint.find("limit"), joint.find("mimic")
    if kind not in _KINDS:
        raise ValueError(f"its type is {kind!r}; choices: {', '.join(_KINDS)}")
    _check_origin(joint)
    if kind in MOVING and axis is not None and np.linalg.norm(numbers(axis, "xyz", 3)) < SHORTEST:
        raise ValueError(f"xyz of <axis> is {axis.get('xyz')!r}, which is no direction")
    if kind in MOVING and limit is not None:
        low, high = (numbers(limit, name, 1, "0", UNLIMITED)[0] for name in ("lower", "upper"))
        free = kind == "continuous" or (kind == "revolute" and low <= -LARGEST and high >= LARGEST)
        for name in () if free else ("lower", "upper"):
            numbers(limit, name, 1, "0")
        numbers(limit, "effort", 1, bound=UNLIMITED)
        _check_positive(limit, "velocity", UNLIMITED)
    for name in ("damping", "friction"):
        numbers(joint.find("dynamics"), name, 1, "0", UNLIMITED)
    if mimic is not None and not mimic.get("joint"):
        raise ValueError("<mimic> has no joint")
    for name in ("multiplier", "offset"):
        numbers(mimic, name, 1, "0")


def _check_positive(element: ET.Element, name: str, bound: float) -> None:
    if numbers(element, name, 1, bound=bound)[0] < 0:
        raise ValueError(f"{name} of <{element.tag}> is {element.get(name)!r}, but must not be negative")


def _check_origin(element: ET.Element) -> None:
    for name in ("xyz", "rpy"):
        numbers(element.find("origin"), name, 3, "0 0 0", FARTHEST)
