"""Steps in a few words, in millimeters and degrees, for lists."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


def summary(step: Mapping[str, Any]) -> str:
    """Return what a step does in a few words."""
    get = step.get
    match step["step"]:
        case "move" | "approach":
            return f"{step['step']} {'straight ' if get('straight') else ''}to {target_text(step['to'])}"
        case "through":
            return f"move through {len(step['points'])} points"
        case "retreat":
            return f"retreat {1e3 * get('distance', 0.1):g} mm"
        case "grip":
            width = step["width"]
            return {"open": "open gripper", "close": "close gripper"}.get(width, "") or f"grip {1e3 * width:g} mm"
        case "output":
            return f"set {step['signal']} {_state(get('value', True))}"
        case "wait":
            return f"wait for {condition_text(step['for'])}" if get("for") else f"wait {step['seconds']:g} s"
        case "loop":
            if get("while"):
                return f"repeat while {condition_text(step['while'])}"
            return "repeat" if get("count") is None else f"repeat {step['count']} times"
        case "if":
            return f"if {condition_text(step['when'])}"
        case "call":
            return f"call {step['program']}"
        case "pick":
            return f"pick {get('object') or get('kind') or 'an object'}"
        case "place":
            return f"place at {target_text(step['at'])}"
        case "palletize":
            counts = [str(step["pattern"].get(name, 1)) for name in ("columns", "rows", "layers")]
            return f"palletize {' x '.join(counts)}"
        case "python":
            return f"python {step['function']}"
    return str(step["step"])


def target_text(target: Any) -> str:
    """Return a target in a few words, in millimeters and degrees."""
    if isinstance(target, str):
        return target
    if "joints" in target:
        return "joints " + ", ".join(f"{180 / math.pi * each:.0f}" for each in target["joints"])
    name = "position" if "position" in target else "by"
    numbers = ", ".join(f"{1e3 * each:.0f}" for each in target.get(name, (0.0, 0.0, 0.0)))
    return target.get("name") or (f"{numbers} mm" if name == "position" else f"here + {numbers} mm")


def condition_text(condition: Mapping[str, Any]) -> str:
    """Return a condition in a few words."""
    if "holding" in condition:
        return "the gripper holds something" if condition["holding"] else "the gripper holds nothing"
    if "outcome" in condition:
        return f"outcome {condition['outcome']}"
    limits = [f"{word} {condition[word]:g}" for word in ("above", "below") if condition.get(word) is not None]
    return f"{condition['signal']} {' and '.join(limits) or _state(condition.get('value', True))}"


def _state(value: Any) -> str:
    return {True: "on", False: "off"}.get(value, "") if isinstance(value, bool) else f"{value:g}"
