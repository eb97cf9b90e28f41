from __future__ import annotations

import datetime
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from common.errors import ConfigError
from common.transport.credentials import credentials_of, observer_identity, require_open_cell
from security.certificates import Authority, write_secret
from security.validation import require_valid

RENEW = "zencell secure init DIR --renew"


@pytest.fixture
def open_umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    authority = Authority.new(10)
    authority.write(tmp_path / "ca.pem", tmp_path / "ca.key")
    authority.issue("panda.camera", [], 10, tmp_path / "panda.camera.pem", tmp_path / "panda.camera.key")
    return tmp_path


@pytest.mark.usefixtures("open_umask")
def test_key_is_readable_by_its_owner_only_whatever_umask_and_previous_mode(tmp_path: Path) -> None:
    place = tmp_path / "x.key"
    for _ in range(2):
        write_secret(place, b"secret")
        assert place.stat().st_mode & 0o777 == 0o600
        place.chmod(0o666)


def test_issued_certificate_is_valid(folder: Path) -> None:
    require_valid(folder, ["panda.camera"], RENEW)


def now_in(days: float) -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)


@pytest.mark.parametrize(("days", "reason"), [(11, "expired on"), (-1, "check the clock here")])
def test_certificate_outside_its_validity_is_named(folder: Path, days: float, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        require_valid(folder, ["panda.camera"], RENEW, now_in(days))


def test_certificate_that_expired_before_its_authority_is_named_with_the_remedy(folder: Path) -> None:
    authority = Authority.load(folder / "ca.pem", folder / "ca.key")
    authority.issue("panda.camera", [], 2, folder / "panda.camera.pem", folder / "panda.camera.key")
    with pytest.raises(ConfigError, match=r"panda\.camera\.pem.*expired on.*--renew"):
        require_valid(folder, ["panda.camera"], RENEW, now_in(3))


def test_process_without_a_certificate_is_named(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"has no panda\.gripper\.pem"):
        require_valid(folder, ["panda.camera", "panda.gripper"], RENEW)


def test_certificate_of_another_authority_is_named(folder: Path) -> None:
    other = Authority.new(10)
    other.issue("panda.camera", [], 10, folder / "panda.camera.pem", folder / "panda.camera.key")
    with pytest.raises(ConfigError, match=r"panda\.camera\.pem.*is not of ca\.pem"):
        require_valid(folder, ["panda.camera"], RENEW)


@pytest.mark.parametrize("exchanged", ["panda.camera.key", "panda.camera.pem"])
def test_key_of_another_certificate_is_refused(folder: Path, exchanged: str) -> None:
    authority = Authority.load(folder / "ca.pem", folder / "ca.key")
    authority.issue("panda.other", [], 10, folder / "other.pem", folder / "other.key")
    (folder / exchanged).write_bytes((folder / f"other.{exchanged[-3:]}").read_bytes())
    with pytest.raises(ConfigError, match="is not that of"):
        require_valid(folder, ["panda.camera"], RENEW)


def test_certificate_for_another_name_is_refused(folder: Path) -> None:
    for kind in ("pem", "key"):
        (folder / f"panda.executor.{kind}").write_bytes((folder / f"panda.camera.{kind}").read_bytes())
    (folder / "panda.executor.key").chmod(0o600)
    with pytest.raises(ConfigError, match=r"panda\.executor\.pem.*is not that of"):
        require_valid(folder, ["panda.executor"], RENEW)


@pytest.mark.parametrize("damaged", ["ca.pem", "panda.camera.pem", "panda.camera.key"])
def test_damaged_file_is_reported_in_one_line(folder: Path, damaged: str) -> None:
    (folder / damaged).write_text("not a certificate")
    with pytest.raises(ConfigError) as caught:
        require_valid(folder, ["panda.camera"], RENEW)
    assert "\n" not in str(caught.value)


def test_key_that_others_can_read_is_refused(folder: Path) -> None:
    (folder / "panda.camera.key").chmod(0o640)
    with pytest.raises(ConfigError, match="chmod 600"):
        credentials_of("panda.camera", folder)


def test_repr_of_credentials_does_not_show_the_key(folder: Path) -> None:
    shown = repr(credentials_of("panda.camera", folder))
    assert (folder / "panda.camera.key").read_text().splitlines()[1] not in shown


def test_recorder_presents_the_observers_certificate_if_it_exists(folder: Path) -> None:
    secured = {"ZENCELL_SECURE": str(folder)}
    assert observer_identity({}) == observer_identity(secured) == "operator"
    (folder / "observer.key").touch()
    assert observer_identity(secured) == "observer"


def test_tools_publish_only_in_an_open_cell(folder: Path) -> None:
    require_open_cell("play", {})
    with pytest.raises(ConfigError, match=r"^play: is not possible"):
        require_open_cell("play", {"ZENCELL_SECURE": str(folder)})
