import datetime
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from common.errors import ConfigError
from common.transport.credentials import credentials_of, observer_identity, require_open_cell
from security.certificates import Authority, write_secret
from security.validation import require_valid
from tests.security.raw_client import issue

RENEW = "zencell secure init DIR --renew"
NAME = "panda.camera"


@pytest.fixture
def open_umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    authority = Authority.new(10)
    authority.write(tmp_path / "ca.pem", tmp_path / "ca.key")
    issue(authority, NAME, tmp_path)
    return tmp_path


def own_authority(folder: Path) -> Authority:
    return Authority.load(folder / "ca.pem", folder / "ca.key")


def swap(kind: str) -> Callable[[Path], None]:
    def swapped(folder: Path) -> None:
        issue(own_authority(folder), "panda.other", folder, file="other")
        (folder / f"{NAME}.{kind}").write_bytes((folder / f"other.{kind}").read_bytes())

    return swapped


def damage(name: str) -> Callable[[Path], object]:
    return lambda folder: (folder / name).write_text("not a certificate")


@pytest.mark.usefixtures("open_umask")
def test_key_is_readable_by_its_owner_only_whatever_umask_and_previous_mode(tmp_path: Path) -> None:
    place = tmp_path / "x.key"
    for _ in range(2):
        write_secret(place, b"secret")
        assert place.stat().st_mode & 0o777 == 0o600
        place.chmod(0o666)


@pytest.mark.parametrize(("change", "reason"), [
    (lambda folder: (folder / f"{NAME}.pem").unlink(), r"has no panda\.camera\.pem"),
    (lambda folder: issue(Authority.new(10), NAME, folder), r"panda\.camera\.pem.*is not of ca\.pem"),
    (lambda folder: issue(own_authority(folder), "panda.other", folder, file=NAME), "is not that of"),
    (swap("key"), "is not that of"),
    (swap("pem"), "is not that of"),
    (damage("ca.pem"), "ca.pem' is not a certificate"),
    (damage(f"{NAME}.pem"), "camera.pem' is not a certificate"),
    (damage(f"{NAME}.key"), "is not of ca.pem"),
    *((lambda folder, mode=mode: (folder / f"{NAME}.key").chmod(mode), "can be read by others: chmod 600 it")
      for mode in (0o640, 0o604, 0o660)),
])
def test_unusable_certificate_or_key_is_refused(folder: Path, change: Callable[[Path], object], reason: str) -> None:
    require_valid(folder, [NAME], RENEW)
    change(folder)
    with pytest.raises(ConfigError, match=reason) as refused:
        require_valid(folder, [NAME], RENEW)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("own_days", "at", "reason"), [
    (10, 11, r"ca\.pem.*expired on.*--renew"), (10, -1, "check the clock here"),
    (2, 3, r"panda\.camera\.pem.*expired on.*--renew"),
])
def test_certificate_outside_its_validity_is_refused(folder: Path, own_days: float, at: float, reason: str) -> None:
    issue(own_authority(folder), NAME, folder, own_days)
    now = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=at)
    with pytest.raises(ConfigError, match=reason):
        require_valid(folder, [NAME], RENEW, now)


def test_repr_of_credentials_does_not_show_the_key(folder: Path) -> None:
    shown = repr(credentials_of(NAME, folder))
    assert (folder / f"{NAME}.key").read_text().splitlines()[1] not in shown


def test_recorder_presents_the_observers_certificate_if_it_exists(folder: Path) -> None:
    secured = {"ZENCELL_SECURE": str(folder)}
    assert observer_identity({}) == observer_identity(secured) == "operator"
    (folder / "observer.key").touch()
    assert observer_identity(secured) == "observer"


def test_tools_publish_only_in_an_open_cell(folder: Path) -> None:
    require_open_cell("play", {})
    with pytest.raises(ConfigError, match=r"^play: is not possible"):
        require_open_cell("play", {"ZENCELL_SECURE": str(folder)})
