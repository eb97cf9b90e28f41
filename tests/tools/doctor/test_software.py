"""Plugged-in cameras, from a fake sysfs."""

from pathlib import Path

from tools.doctor import examination as software


def plug(sys: Path, port: str, **attributes: str) -> None:
    folder = sys / "bus/usb/devices" / port
    folder.mkdir(parents=True)
    for name, text in attributes.items():
        (folder / name).write_text(text + "\n", encoding="utf-8")


def video(sys: Path, number: int, name: str, index: int) -> None:
    folder = sys / f"class/video4linux/video{number}"
    folder.mkdir(parents=True)
    (folder / "name").write_text(name + "\n", encoding="utf-8")
    (folder / "index").write_text(f"{index}\n", encoding="utf-8")


def test_plugged_in_cameras_are_listed_with_their_drivers(tmp_path, monkeypatch):
    assert list(software.cameras(tmp_path)) == []
    monkeypatch.setattr(software, "find_spec", lambda package: object() if package == "depthai" else None)
    plug(tmp_path, "2-1", idVendor="8086", product="Intel(R) RealSense(TM) Depth Camera 435i", serial="0123")
    plug(tmp_path, "2-2", idVendor="03e7", product="Luxonis Device")
    plug(tmp_path, "2-3", idVendor="8086", product="AX211 Bluetooth")
    plug(tmp_path, "2-4")
    for number, name, index in ((10, "HD Webcam", 0), (2, "Other", 0), (11, "HD Webcam", 1)):
        video(tmp_path, number, name, index)
    realsense, oak, *others = software.cameras(tmp_path)
    assert realsense.level == "warn" and "435i 0123: pyrealsense2 is not installed" in realsense.what
    assert "zencell[realsense]" in realsense.remedy
    assert (oak.level, oak.what) == ("ok", "depth camera OAK Luxonis Device (driver: oak of real_depth_camera)")
    assert [finding.what for finding in others] == [
        "camera /dev/video2: Other (camera_opencv)", "camera /dev/video10: HD Webcam (camera_opencv)"]


def test_depth_camera_is_not_listed_again_as_a_video_device(tmp_path):
    plug(tmp_path, "2-1", idVendor="8086", product="Intel(R) RealSense(TM) Depth Camera 435i")
    plug(tmp_path, "2-11")
    for number, port in ((0, "2-1"), (1, "2-11")):
        video(tmp_path, number, f"at {port}", 0)
        interface = tmp_path / "bus/usb/devices" / port / f"{port}:1.0"
        interface.mkdir()
        (tmp_path / f"class/video4linux/video{number}/device").symlink_to(interface)
    assert [finding.what[:22] for finding in software.cameras(tmp_path)] == [
        "depth camera RealSense", "camera /dev/video1: at"]
