"""Admission of HTTP requests to the page, without a network."""

import socket
from http import HTTPStatus
from pathlib import Path

import pytest

from common.errors import ConfigError
from page.access import Access, cookie_value, gateways
from page.address import is_loopback, page_url
from security.certificates import write_secret
from security.page_tokens import ROLES, TOKEN_PATTERN, make_token, read_tokens, token_file

SECRET = "correct-horse-battery"
LOCAL = Access("127.0.0.1", 8080)
REMOTE = Access("0.0.0.0", 8080, SECRET)
NAMED = Access("cell.lab", 8080, SECRET)
COOKIE = f"other=1; zencell-8080={cookie_value(SECRET, 8080)}"
OWN = "127.0.0.1:8080"


def status(access: Access, host: str | list[str] = OWN, origin: str | list[str] = [], cookie: str = "",  # noqa: B006
           path: str = "/", upgrade: bool = True) -> int:
    """Return the status of the answer to a request, 0 for an admitted one."""
    headers = {
        "host": [host] if isinstance(host, str) else host,
        "origin": [origin] if isinstance(origin, str) else origin,
        "cookie": [cookie] if cookie else [],
    }
    answer = access.check(path, headers, upgrade=upgrade)
    return answer.status.value if answer else 0


@pytest.mark.parametrize(("access", "hosts"), [
    (LOCAL, (OWN, "127.0.0.1", "localhost:8080", "LocalHost:9000", "[::1]:8080")),
    (REMOTE, ("192.168.1.7:8080", "[fe80::1]:8080", "localhost", socket.gethostname())),
    (NAMED, ("cell.lab:8080", "CELL.lab:8080")),
])
def test_own_host_names_are_served_and_foreign_ones_rejected(access: Access, hosts: tuple[str, ...]) -> None:
    assert [host for host in hosts if status(access, host, cookie=COOKIE)] == []
    assert status(access, "evil.example:8080", cookie=COOKIE) == HTTPStatus.FORBIDDEN


@pytest.mark.parametrize("host", [
    "localhost.evil.example", "127.0.0.1.evil.example", "10.0.0.1:8080", "2130706433", "", "a b",
    "127.0.0.1@evil.example", "localhost:", "localhost/", "[::1", "::1", [], ["localhost", "localhost"],
    ["localhost", "evil.example"],
])
def test_foreign_host_names_are_rejected_on_a_local_page(host: str | list[str]) -> None:
    assert status(LOCAL, host) == status(LOCAL, host, upgrade=False) == HTTPStatus.FORBIDDEN


@pytest.mark.parametrize(("host", "origin"), [
    (OWN, "http://127.0.0.1:8080"), ("localhost:9000", "http://localhost:9000"),
    ("LOCALHOST:8080", "http://localhost:8080"), ("localhost", "http://localhost:80"),
    ("localhost:80", "http://localhost"), ("localhost", "https://localhost"), ("[::1]:8080", "http://[::1]:8080"),
])
def test_own_page_may_open_a_websocket(host: str, origin: str) -> None:
    assert status(LOCAL, host, origin) == 0


@pytest.mark.parametrize("origin", [
    "http://evil.example", "http://127.0.0.1:8081", "http://127.0.0.1", "http://localhost:8080", "null", "",
    "http://127.0.0.1:8080.evil.example", "http://evil.example@127.0.0.1:8080", "file://", "http://127.0.0.1:8080/",
    "chrome-extension://127.0.0.1:8080", ["http://127.0.0.1:8080", "http://evil.example"],
])
def test_foreign_origins_are_rejected_even_with_a_token(origin: str | list[str]) -> None:
    assert status(LOCAL, OWN, origin) == status(REMOTE, OWN, origin, COOKIE) == HTTPStatus.FORBIDDEN


@pytest.mark.parametrize("upgrade", [True, False])
def test_nothing_is_served_without_the_token(upgrade: bool) -> None:
    for path in ("/", "/index.html", "/?token=", "/?token=correct-horse-batterx", "/?tokem=" + SECRET, "/" + SECRET):
        for cookie in ("", f"zencell-8081={cookie_value(SECRET, 8081)}", f"zencell-8080={SECRET}", "zencell-8080=",
                       "zencell-8080=wrong", SECRET):
            assert status(REMOTE, OWN, [], cookie, path, upgrade) == HTTPStatus.UNAUTHORIZED
    assert status(REMOTE, cookie="zencell-8080=é\udcff", path="/?token=%ff%C3%A9") == HTTPStatus.UNAUTHORIZED


def test_token_in_the_url_becomes_a_cookie_and_may_come_with_a_websocket() -> None:
    answer = REMOTE.check(f"/?token={SECRET}", {"host": [OWN]}, upgrade=False)
    assert answer.status == HTTPStatus.OK and SECRET not in answer.text
    cookie, *flags = answer.headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict"} <= set(flags)
    assert status(REMOTE, cookie=cookie, upgrade=False) == status(REMOTE, OWN, f"http://{OWN}", cookie) == 0
    assert status(REMOTE, path=f"/?token={SECRET}") == 0


def test_loopback_addresses_are_recognized() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.8.9.10", "localhost", "::1")))
    assert not any(map(is_loopback, ("0.0.0.0", "::", "192.168.0.1", "cell.lab", "localhost.evil.example", "")))


def test_page_url_can_be_opened() -> None:
    assert page_url("127.0.0.1", 8080) == "http://127.0.0.1:8080"
    assert page_url("::1", 8080) == "http://[::1]:8080"
    assert page_url("cell.lab", 80) == "http://cell.lab:80"
    assert "0.0.0.0" not in page_url("0.0.0.0", 8080) and "::" not in page_url("::", 8080)


@pytest.mark.parametrize(("admitted", "peers"), [
    (True, ("127.0.0.1", "127.8.9.1", "::1", "::ffff:127.0.0.1", "172.18.0.1", "::ffff:172.18.0.1")),
    (False, ("172.18.0.7", "::ffff:172.18.0.7", "fe80::1%eth0", "")),
])
def test_without_a_token_the_peer_address_decides(peers: tuple[str, ...], admitted: bool) -> None:
    published = Access("127.0.0.1", 8080, trusted_peers=frozenset({"172.18.0.1"}))
    for peer in peers:
        answer = published.check("/", {"host": [OWN]}, upgrade=True, peer=peer)
        assert (answer is None) is admitted, peer
        assert answer is None or (answer.status is HTTPStatus.UNAUTHORIZED and "ZENCELL_VIEWER_TOKEN" in answer.text)


def test_gateway_of_a_container_is_that_of_the_default_route(tmp_path: Path) -> None:
    table = tmp_path / "route"
    rows = ["Iface Destination Gateway Flags", "eth1 00000000 010012AC 0003", "eth0 000013AC 00000000 0001", ""]
    table.write_text("\n".join(rows).replace(" ", "\t"))
    assert gateways(table) == {"172.18.0.1"}
    assert gateways(tmp_path / "none") == frozenset()


def test_each_token_grants_its_role_and_the_general_one_all_roles() -> None:
    tokens = {role: f"{role}-token-of-the-page" for role in ROLES}
    access = Access("127.0.0.1", 8080, SECRET, tokens)
    for role, token in tokens.items():
        assert access.roles([f"zencell-8080={cookie_value(token, 8080)}"]) == {"look", role}
        cookie = f"zencell-8080={cookie_value(token, 8080)}"
        assert status(access, cookie=cookie) == status(access, path=f"/?token={token}") == 0
    assert access.roles([COOKIE]) == LOCAL.roles([]) == set(ROLES)
    assert not access.roles([
        "zencell-8080=look", f"zencell-8080={SECRET}", f"zencell-8081={cookie_value(SECRET, 8081)}"])
    assert status(access) == HTTPStatus.UNAUTHORIZED
    assert SECRET not in repr(access) and "of-the-page" not in repr(access), "a log must not show tokens"


def test_new_tokens_are_long_and_unique_and_need_no_escaping() -> None:
    tokens = {make_token() for _ in range(100)}
    assert len(tokens) == 100 and all(len(token) >= 40 and TOKEN_PATTERN.fullmatch(token) for token in tokens)


def test_token_files_must_be_private_and_valid(tmp_path: Path) -> None:
    assert read_tokens(tmp_path, "panda") == {}
    for role in ROLES[:2]:
        write_secret(token_file(tmp_path, "panda", role), f"{role}-token-of-the-page\n".encode())
    assert read_tokens(tmp_path, "panda") == {role: f"{role}-token-of-the-page" for role in ROLES[:2]}
    token_file(tmp_path, "panda", "look").chmod(0o640)
    with pytest.raises(ConfigError, match=r"panda\.page\.look' is readable by other users: run chmod 600 on it"):
        read_tokens(tmp_path, "panda")
    write_secret(token_file(tmp_path, "panda", "look"), b"short\n")
    with pytest.raises(ConfigError, match=r"panda\.page\.look' contains no valid token"):
        read_tokens(tmp_path, "panda")
