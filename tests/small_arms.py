"""Descriptions of arms as text: a SCARA, one that only turns and nods, and one of six joints and any size."""

_HAND = """
<link name="palm"><collision><origin xyz="0 0 0.02"/><geometry><box size="0.03 0.09 0.04"/></geometry></collision>
</link>
<joint name="to_palm" type="fixed"><parent link="{wrist}"/><child link="palm"/><origin xyz="{at}"/></joint>
<link name="left"><collision><origin xyz="0 0.005 0.03"/><geometry><box size="0.015 0.01 0.06"/></geometry></collision>
</link>
<link name="right"><collision><origin xyz="0 -0.005 0.03"/><geometry><box size="0.015 0.01 0.06"/></geometry>
</collision></link>
<joint name="left_finger" type="prismatic"><parent link="palm"/><child link="left"/><origin xyz="0 0 0.04"/>
 <axis xyz="0 1 0"/><limit lower="0" upper="0.04" velocity="0.1" effort="20"/></joint>
<joint name="right_finger" type="prismatic"><parent link="palm"/><child link="right"/><origin xyz="0 0 0.04"/>
 <axis xyz="0 -1 0"/><limit lower="0" upper="0.04" velocity="0.1" effort="20"/><mimic joint="left_finger"/></joint>
"""


def _link(name: str, size: str = "", at: str = "0 0 0") -> str:
    shape = (f'<collision><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></collision>' if size else "")
    return f'<link name="{name}">{shape}</link>'


def _joint(name: str, kind: str, parent: str, child: str, at: str, axis: str, low: float, high: float,
           rpy: str = "0 0 0") -> str:
    speed = 0.5 if kind == "prismatic" else 2.5
    return (f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{at}" rpy="{rpy}"/><axis xyz="{axis}"/>'
            f'<limit lower="{low}" upper="{high}" velocity="{speed}" effort="100"/></joint>')


def scara() -> str:
    """A SCARA: two joints that swing, a slide, and one that turns the hand; it always points down."""
    return "\n".join([
        '<robot name="scara">',
        _link("column", "0.12 0.12 0.58", "0 0 0.29"),
        _link("upper", "0.34 0.08 0.06", "0.17 0 0"), _link("fore", "0.3 0.07 0.06", "0.15 0 0"),
        _link("quill", "0.03 0.03 0.3", "0 0 0"), _link("wrist"),
        _joint("shoulder", "revolute", "column", "upper", "0 0 0.62", "0 0 1", -2.6, 2.6),
        _joint("elbow", "revolute", "upper", "fore", "0.34 0 0.07", "0 0 1", -2.6, 2.6),
        _joint("lift", "prismatic", "fore", "quill", "0.3 0 -0.2", "0 0 1", -0.25, 0.0),
        _joint("turn", "revolute", "quill", "wrist", "0 0 -0.15", "0 0 1", -3.1, 3.1),
        _HAND.format(wrist="wrist", at='0 0 0" rpy="3.14159265 0 0'), "</robot>"])


def nodding() -> str:
    """It turns, and nods at shoulder, elbow and wrist: its hand is turned as the place wants it."""
    return "\n".join([
        '<robot name="nodding">',
        _link("base", "0.12 0.12 0.1", "0 0 0.05"), _link("body", "0.08 0.08 0.12", "0 0 0.06"),
        _link("upper", "0.05 0.05 0.34", "0 0 0.17"), _link("fore", "0.045 0.045 0.3", "0 0 0.15"),
        _link("wrist", "0.04 0.04 0.06", "0 0 0.03"),
        _joint("pan", "revolute", "base", "body", "0 0 0.1", "0 0 1", -2.6, 2.6),
        _joint("shoulder", "revolute", "body", "upper", "0 0 0.14", "0 1 0", -1.9, 1.9),
        _joint("elbow", "revolute", "upper", "fore", "0 0 0.36", "0 1 0", -2.5, 2.5),
        _joint("wrist_nod", "revolute", "fore", "wrist", "0 0 0.32", "0 1 0", -2.2, 2.2),
        _HAND.format(wrist="wrist", at="0 0 0.06"), "</robot>"])


def six(size: float) -> str:
    """Six joints, from the size of an arm on a desk, 0.08, to that of one on the floor of a factory, 1."""
    links = {"base": (0.6, 0.6), "l1": (0.5, 0.5), "l2": (0.3, 1.4), "l3": (0.3, 0.6), "l4": (0.25, 0.6),
             "l5": (0.25, 0.3), "l6": (0.2, 0.1)}
    joints = [("base", "l1", 0.75, "0 0 1", -2.9, 2.9), ("l1", "l2", 0.5, "0 1 0", -1.2, 2.0),
              ("l2", "l3", 1.5, "0 1 0", 0.2, 1.9), ("l3", "l4", 0.75, "0 0 1", -2.9, 2.9),
              ("l4", "l5", 0.75, "0 1 0", -2.1, 2.1), ("l5", "l6", 0.4, "0 0 1", -3.1, 3.1)]
    return "\n".join([
        '<robot name="six">',
        *(_link(name, f"{wide * size} {wide * size} {long * size}", f"0 0 {long * size / 2}")
          for name, (wide, long) in links.items()),
        *(_joint(f"j{number}", "revolute", parent, child, f"0 0 {high * size}", axis, low, top)
          for number, (parent, child, high, axis, low, top) in enumerate(joints)),
        _HAND.format(wrist="l6", at=f"0 0 {0.1 * size}"), "</robot>"])
