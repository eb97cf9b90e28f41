"""Descriptions as makers ship them, and as attackers do: packages, xacro, paths of another machine, bounds."""

import gzip
from pathlib import Path

import pytest
import trimesh

from common.config import RobotConfig, check
from common.errors import ConfigError
from common.robot.model import RobotModel
from common.robot.visual_meshes import visual_pieces
from tools.robot_setup.descriptions import Reader

XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'
BOX = trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type="stl")


def shape(kind: str, mesh: str) -> str:
    return f'<{kind}><geometry><mesh filename="{mesh}"/></geometry></{kind}>'


def arm(inside: str) -> str:
    return (f'<robot name="arm"><link name="base">{inside}</link><link name="tip"/><joint name="turn" type="revolute">'
            '<parent link="base"/><child link="tip"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
            '</robot>')


def package(folder: Path, name: str) -> Path:
    (folder / "meshes").mkdir(parents=True)
    (folder / "package.xml").write_text(f'<?xml version="1.0"?><package format="3">\n <name>{name}</name></package>')
    (folder / "meshes" / "link.stl").write_bytes(BOX)
    return folder


@pytest.mark.parametrize("mesh", [
    "package://that_arm/meshes/link.stl",
    "file:///srv/someone/ws/install/that_arm/share/that_arm/meshes/link.stl",
    "/srv/some%20one/ws/src/clone/that_arm/meshes/link.stl",
    "file:///C:/ws/that_arm/meshes/link.stl",
])
@pytest.mark.parametrize(("place", "given"), [
    ("src/a_clone", ["."]), ("src/a_clone", ["src/a_clone"]), ("src/repository/nested/a_clone", ["src"]),
    ("description", []), ("that_arm", []), ("src/repository/exported_by_CAD", []),
])
def test_package_is_found_by_its_name_wherever_it_is(mesh, place, given, tmp_path):
    folder = package(tmp_path / place, "that_arm")
    if "CAD" in place:
        (folder / "package.xml").write_text("<package><name>another_name</name></package>")
    urdf = tmp_path / "arm.urdf" if given or place == "that_arm" else folder / "urdf" / "arm.urdf"
    urdf.parent.mkdir(exist_ok=True)
    urdf.write_text(arm(shape("collision", mesh)))
    reader = Reader([str(tmp_path / each) for each in given])
    found = reader.read("urdf", str(urdf))
    assert [each.get("filename") for each in found.root.iter("mesh")] == [str(folder / "meshes" / "link.stl")]
    assert bool(found.notes) == (not mesh.startswith("package") or "CAD" in place)
    robot = RobotModel.load(check(RobotConfig, {
        "name": "arm", "urdf": str(urdf), "package_dirs": reader.folders, "joints": ["turn"], "base_link": "base",
        "tcp_link": "tip", "named_poses": {"home": [0.0]}, "acceleration_limits": [1], "jerk_limits": [1]}, "robot"))
    assert str(tmp_path) not in reader.found
    assert len(robot.full_geometry().geometryObjects) == 1


def test_missing_visual_mesh_is_reported_and_drawn_by_the_collision_shape(tmp_path):
    path = tmp_path / "arm.urdf"
    ball = "<collision><geometry><sphere radius='1'/></geometry></collision>"
    path.write_text(arm(shape("visual", "gone.dae") + ball))
    assert Reader([]).read("urdf", str(path)).notes == [
        "mesh gone.dae is missing: the link is drawn by its collision shape"]
    robot = RobotModel.load(check(RobotConfig, {
        "name": "arm", "urdf": str(path), "joints": ["turn"], "base_link": "base", "tcp_link": "tip",
        "named_poses": {"home": [0.0]}, "acceleration_limits": [1], "jerk_limits": [1]}, "robot"))
    assert [piece.link for piece in visual_pieces(robot)] == ["base"]


def test_packages_of_a_sourced_ros_are_found_through_links_into_its_source(tmp_path, monkeypatch):
    folder = package(tmp_path / "ws" / "src" / "clone", "that_arm")
    (folder / "limits.yaml").write_text("name: found\n")
    share = tmp_path / "ws" / "install" / "share" / "that_arm"
    share.mkdir(parents=True)
    for each in ("package.xml", "limits.yaml", "meshes"):
        (share / each).symlink_to(folder / each)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/opt/none:{tmp_path / 'ws' / 'install'}")
    path = tmp_path / "elsewhere" / "arm.xacro"
    path.parent.mkdir()
    path.write_text(f'<robot {XACRO}><link name="${{load_yaml(\'$(find that_arm)/limits.yaml\').name}}">'
                    f'{shape("collision", "package://that_arm/meshes/link.stl")}</link></robot>')
    assert Reader([]).read("urdf", str(path)).root[0].get("name") == "found"


def names(name: str) -> bytes:
    return arm("").replace('"turn"', f'"{name}"').encode()


LIMIT, TIP = '<limit lower="-1" upper="1" velocity="1" effort="1"/>', '<link name="tip"/>'
VALUES = {  # change of the arm: part of its line
    (LIMIT, LIMIT.replace('"-1"', '"nan"')): "joint 'turn' that is unusable: lower of <limit> is 'nan'",
    (LIMIT, LIMIT.replace('"-1"', '"-1e30"')): "lower of <limit> is '-1e30'",
    (LIMIT, LIMIT.replace('"-1"', '"-1 -2"')): "lower of <limit> is '-1 -2', but must be a number",
    (LIMIT, LIMIT.replace('velocity="1"', 'velocity="-1"')): "velocity of <limit> is '-1', but must not be negative",
    (LIMIT, LIMIT.replace('effort="1"', "")): "<limit> has no effort",
    (LIMIT, LIMIT + '<dynamics damping="x"/>'): "damping of <dynamics> is 'x'",
    (LIMIT, LIMIT + "<mimic/>"): "<mimic> has no joint",
    (LIMIT, LIMIT + "<axis/>"): "<axis> has no xyz",
    ("revolute", "spinny"): "its type is 'spinny'; choices: revolute",
    ('name="tip"', 'name="base"'): "more than one link called 'base'",
    ("</robot>", '<joint name="turn" type="fixed"/></robot>'): "more than one joint called 'turn'",
    ('name="turn"', 'name=" "'): "a joint without a name",
    **{(LIMIT, f'{LIMIT}<{tag} {key}="{value}"/>'): f"{key} of <{tag}> is {value!r}" for tag, key, values in (
        ("origin", "xyz", ("0 nan 0", "inf 0 0", "0 0 1e30", "0 0", "0 0 300", "1_0 0 0", "0 0 \u0663")),
        ("origin", "rpy", ("nan 0 0", "0 0 0 0", "1e30 0 0")),
        ("axis", "xyz", ("0 1", "nan 0 1", "0 0 0", "0 -0.0 0.0", "1e300 0 0", "1e-300 0 0")),
    ) for value in values},
    **{(TIP, f'<link name="tip"><inertial>{part}</inertial></link>'): f"link 'tip' that is unusable: {wanted}"
       for part, wanted in (('<mass value="nan"/>', "value of <mass> is 'nan'"), ("<mass/>", "<mass> has no value"),
                            ('<mass value="-1"/>', "value of <mass> is '-1', but must not be negative"),
                            ('<inertia ixy="x"/>', "ixy of <inertia> is 'x'"),
                            ('<origin xyz="0 0"/>', "xyz of <origin> is '0 0'"))},
}


@pytest.mark.parametrize(("content", "wanted"), [
    (b"", "is empty"), (b" \n", "is empty"), (gzip.compress(b"<robot/>", mtime=0), "unpack it"),
    (b"\n<!DOCTYPE html>\n<html></html>", "download the raw file"),
    (b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"),
    (arm(shape("collision", "pointer.stl")).encode(), "git lfs pull"),
    (arm(shape("collision", "gone.stl")).encode(), "missing"),
    (arm(shape("collision", "a&#10;zencell: all is well.stl")).encode(), "a\\u000azencell"),
    (arm(shape("collision", "http://x/gone.stl")).encode(), "missing"),
    (("<robot>" + "<a>" * 200_000 + "</a>" * 200_000 + "</robot>").encode(), "nested"),
    (("<robot>" + "<a/>" * 300_000 + "</robot>").encode(), "more than 200000 elements"),
    (("<robot>" + "".join(f'<link name="l{i}"/>' for i in range(3000)) + "</robot>").encode(), "3000 links"),
    (b'<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>', "entities"),
    (b'<!DOCTYPE r [<!ENTITY a SYSTEM "/etc/passwd">]><robot>&a;</robot>', "entities"),
    ('<!DOCTYPE r [<!ENTITY a "b">]><robot name="&a;"/>'.encode("utf-16"), "entities"),
    (b'<?xml version="1.0" encoding="nonsense"?><robot/>', "does not parse"),
    *((names(f"turn{each}gripper: 1"), "has a name with the character") for each in (
        "\u2028", "\u2029", "\u0085", "&#10;", "&#9;", "\u202e", "\u200b")),
    (("<robot>" + "".join(f'<link name="l{i}"/>' for i in range(401)) + "</robot>").encode(), "401 links"),
    (names("x" * 500), "500 characters"),
    *((arm("").replace(*change).encode(), wanted) for change, wanted in VALUES.items()),
])
def test_file_that_is_no_usable_description_is_one_line(content, wanted, tmp_path):
    (tmp_path / "pointer.stl").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:1\n")
    (tmp_path / "arm.urdf").write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        Reader([]).read("urdf", str(tmp_path / "arm.urdf"))
    assert wanted in str(caught.value) and len(str(caught.value).splitlines()) == 1


def expand(tmp_path: Path, body: str, *, trust: bool = False, **arguments: str) -> list[str]:
    """Return the values of the first link of a xacro file in the package `mine`."""
    if not (tmp_path / "mine").exists():
        package(tmp_path / "mine", "mine_description")
    path = tmp_path / "mine" / "arm.xacro"
    path.write_text(f'<robot name="x" {XACRO}>{body}</robot>')
    root = Reader([], arguments, trust).read("urdf", str(path)).root
    return [element.get("name", "") for element in root.iter("link")]


def test_xacro_as_makers_write_it(tmp_path):
    package(tmp_path / "mine", "mine_description")
    (tmp_path / "mine" / "limits.yaml").write_text("joints: {turn: {upper: !degrees 180, name: elbow}}\n")
    body = ('<xacro:arg name="prefix" default="left_"/><xacro:property name="all" '
            'value="${xacro.load_yaml(\'$(find mine_description)/limits.yaml\')}"/>'
            '<xacro:property name="type" value="7"/>'
            '<xacro:macro name="m" params="name:=^|none n"><link name="$(arg prefix)${name}_${n + 1}"/>'
            '<xacro:if value="${n > 0}"><xacro:m n="${n - 1}"/></xacro:if></xacro:macro><xacro:m name="a" n="1"/>'
            '<link name="${all[\'joints\'][\'turn\'].name}_${round(all.joints.turn.upper, 2)}_${type}"/>'
            '<link name="${\'a b\'.split()[1]}${[radians(180) &gt; x for x in (3, 4)]}"/>'
            '<link name="$(eval 1 + 2)$(optenv HOME nowhere)"/><xacro:include filename="$(dirname)/other.xacro"/>')
    (tmp_path / "mine" / "other.xacro").write_text(
        f'<robot {XACRO}><link name="${{\'$(find-pkg-share mine_description)\'.endswith(\'mine\')}}"/></robot>')
    assert expand(tmp_path, body) == ["left_a_2", "left_a_1", "elbow_3.14_7", "b[True, False]", "3nowhere", "True"]
    assert expand(tmp_path, body, prefix="r_")[0] == "r_a_2"


ATTACKS = {
    "${().__class__.__base__.__subclasses__()}": "__subclasses__", "${__import__('os').system('id')}": "__import__",
    "${python.type(1)}": "type", "${python.vars(xacro)}": "vars", "${(x for x in [1]).gi_frame.f_builtins}": "gi_frame",
    "${'%s'.format}": "format", "${(lambda: 1)()}": "Lambda", "${xacro.load_yaml.func_globals}": "func_globals",
    "${xacro.load_yaml('HOME/secret.yaml')}": "opens", "${load_yaml('/etc/passwd')}": "opens",
    "${xacro.load_yaml('link.yaml')}": "opens", "${xacro.load_yaml('.hidden.yaml')}": "opens",
    "${xacro.fatal('a\\nb' * 9999)}": "a ba b", "$(env HOME)": "HOME",
    "$(find ../../etc)": "needs the package", "${'a' * 10**12}": "needs more than",
    "${list(python.range(10**11))}": "needs more than",
}


@pytest.mark.parametrize("attack", ATTACKS)
def test_expression_of_a_stranger_reaches_neither_python_nor_files_nor_the_environment(attack, tmp_path, monkeypatch):
    home = tmp_path / "home"
    home.mkdir()
    (home / "secret.yaml").write_text("secret")
    monkeypatch.setenv("HOME", str(home))
    expand(tmp_path, "<link name='a'/>")
    (tmp_path / "mine" / "link.yaml").symlink_to(home / "secret.yaml")
    (tmp_path / "mine" / ".hidden.yaml").write_text("secret")
    text = attack.replace("HOME/", f"{home}/")
    with pytest.raises(ConfigError) as caught:
        expand(tmp_path, f'<link name="{text}"/>')
    assert ATTACKS[attack] in str(caught.value) and len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 700


def test_xacro_in_the_home_folder_opens_none_of_its_files(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "secret.yaml").write_text("secret")
    (tmp_path / "arm.xacro").write_text(f'<robot {XACRO}><link name="${{load_yaml(\'secret.yaml\')}}"/></robot>')
    with pytest.raises(ConfigError, match="opens"):
        Reader([]).read("urdf", str(tmp_path / "arm.xacro"))


@pytest.mark.parametrize(("body", "wanted"), [
    ('<xacro:macro name="m"><xacro:m/></xacro:macro><xacro:m/>', "call themselves"),
    ('<xacro:include filename="arm.xacro"/>', "call themselves"),
    ('<xacro:include filename="/etc/passwd"/>', "opens"), ("<a>" * 9999 + "</a>" * 9999, "nested"),
    pytest.param('<link name="${10**10**10}"/>', "processor time", marks=pytest.mark.slow),
])
def test_xacro_without_end_is_one_line(body, wanted, tmp_path):
    with pytest.raises(ConfigError, match=wanted):
        expand(tmp_path, body)


def test_trust_lets_expressions_read_the_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("PLACE", "left")
    assert expand(tmp_path, '<link name="$(env PLACE)"/>', trust=True) == ["left"]
