"""Files of certificates that other users could change are rejected; links are not followed when they are written."""

import os
import shutil
from pathlib import Path

import pytest

from common.errors import ConfigError
from common.transport.credentials import credentials_of, read_access
from security.certificates import write_file


@pytest.mark.parametrize(("name", "mode"), [
    ("access.json5", 0o666), ("access.json5", 0o664), ("", 0o777), ("", 0o770), ("ca.pem", 0o646),
    ("operator.pem", 0o662),
])
def test_what_other_users_can_change_is_rejected(certificates: Path, tmp_path: Path, name: str, mode: int) -> None:
    folder = tmp_path / "certs"
    shutil.copytree(certificates, folder)
    credentials_of("operator", folder)
    read_access(folder)
    (folder / name).chmod(mode)
    with pytest.raises(ConfigError, match="can be changed by other users"):
        credentials_of("operator", folder)
        read_access(folder)


def test_folder_where_each_user_replaces_only_own_files_is_accepted(certificates: Path, tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    shutil.copytree(certificates, folder)
    folder.chmod(0o1777)
    assert credentials_of("operator", folder) and read_access(folder)


@pytest.mark.parametrize("link", [os.symlink, os.link, lambda target, path: os.mkfifo(path)])
def test_no_link_of_another_user_is_followed(tmp_path: Path, link) -> None:
    target, path = tmp_path / "target", tmp_path / "router.pem"
    target.write_text("precious")
    link(target, path)
    with pytest.raises(ConfigError, match="is a link or no regular file"):
        write_file(path, b"new")
    assert target.read_text() == "precious"


def test_rewritten_file_has_only_the_new_contents_and_permissions(tmp_path: Path) -> None:
    path = tmp_path / "access.json5"
    path.write_text("longer than the new text")
    path.chmod(0o666)
    write_file(path, b"new")
    assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"new", 0o644)
