"""The rules of who may open the page, without a network."""

import socket
from http import HTTPStatus
from pathlib import Path

import pytest

from common.errors import ConfigError
from page.access import (
    ROLES,
    TOKEN,
    Access,
    address_of,
    gateways,
    is_loopback,
    make_token,
    token_file,
    tokens_in,
)
from security.certificates import write_secret

SECRET = "correct-horse-battery"
HERE = Access("127.0.0.1", 8080)
WIDE = Access("0.0.0.0", 8080, SECRET)
NAMED = Access("cell.lab", 8080, SECRET)
COOKIE = f"other=1; zencell-8080={SECRET}"


def status(access: Access, host: str | list[str], origin: str | list[str] = [], cookie: str = "",  # noqa: B006
           path: str = "/", upgrade: bool = True) -> int:
    """Status of the answer to a request, 0 when it may pass."""
    headers = {
        "host": [host] if isinstance(host, str) else host,
        "origin": [origin] if isinstance(origin, str) else origin,
        "cookie": [cookie] if cookie else [],
    }
    answer = access.answer(path, headers, upgrade=upgrade)
    return answer.status.value if answer else 0


@pytest.mark.parametrize("host", ["127.0.0.1", "127.0.0.1:8080", "localhost:8080", "LocalHost:9000", "[::1]:8080"])
def test_names_of_this_machine_itself_are_served_by_whatever_port_they_came(host: str) -> None:
    assert status(HERE, host) == 0


@pytest.mark.parametrize("host", [
    "evil.example:8080", "localhost.evil.example", "127.0.0.1.evil.example", "10.0.0.1:8080", "2130706433", "", "a b",
    "127.0.0.1@evil.example", "localhost:", "localhost/", "[::1", "::1", [], ["localhost", "localhost"],
    ["localhost", "evil.example"],
])
def test_other_names_are_refused(host: str | list[str]) -> None:
    assert status(HERE, host) == status(HERE, host, upgrade=False) == HTTPStatus.FORBIDDEN


@pytest.mark.parametrize(("host", "origin"), [
    ("127.0.0.1:8080", "http://127.0.0.1:8080"), ("localhost:9000", "http://localhost:9000"),
    ("LOCALHOST:8080", "http://localhost:8080"), ("localhost", "http://localhost:80"),
    ("localhost:80", "http://localhost"), ("localhost", "https://localhost"), ("[::1]:8080", "http://[::1]:8080"),
])
def test_page_of_our_own_may_open_its_socket(host: str, origin: str) -> None:
    assert status(HERE, host, origin) == 0


@pytest.mark.parametrize("origin", [
    "http://evil.example", "http://127.0.0.1:8081", "http://127.0.0.1", "http://localhost:8080", "null", "",
    "http://127.0.0.1:8080.evil.example", "http://evil.example@127.0.0.1:8080", "file://", "http://127.0.0.1:8080/",
    "chrome-extension://127.0.0.1:8080", ["http://127.0.0.1:8080", "http://evil.example"],
])
def test_another_web_page_is_refused_whatever_token_its_browser_has(origin: str | list[str]) -> None:
    assert status(HERE, "127.0.0.1:8080", origin) == HTTPStatus.FORBIDDEN
    assert status(WIDE, "127.0.0.1:8080", origin, COOKIE) == HTTPStatus.FORBIDDEN


@pytest.mark.parametrize("upgrade", [True, False])
def test_without_the_token_nothing_is_served(upgrade: bool) -> None:
    for path in ("/", "/index.html", "/?token=", "/?token=correct-horse-batterx", "/?tokem=" + SECRET, "/" + SECRET):
        for cookie in ("", f"zencell-8081={SECRET}", "zencell-8080=", "zencell-8080=wrong", SECRET):
            assert status(WIDE, "127.0.0.1:8080", [], cookie, path, upgrade) == HTTPStatus.UNAUTHORIZED


def test_token_in_the_address_becomes_a_cookie_that_opens_the_page() -> None:
    answer = WIDE.answer(f"/?token={SECRET}", {"host": ["127.0.0.1:8080"]}, upgrade=False)
    assert answer is not None and answer.status == HTTPStatus.OK and SECRET not in answer.text
    cookie, *flags = answer.headers["Set-Cookie"].split("; ")
    assert {"HttpOnly", "SameSite=Strict"} <= set(flags)
    assert status(WIDE, "127.0.0.1:8080", [], cookie, upgrade=False) == 0
    assert status(WIDE, "127.0.0.1:8080", "http://127.0.0.1:8080", cookie) == 0


def test_program_may_bring_the_token_with_its_socket() -> None:
    assert status(WIDE, "127.0.0.1:8080", path=f"/?token={SECRET}") == 0


def test_letters_beyond_ascii_are_no_token_and_no_error() -> None:
    assert status(WIDE, "127.0.0.1:8080", [], "zencell-8080=é\udcff", "/?token=%ff%C3%A9") == HTTPStatus.UNAUTHORIZED


@pytest.mark.parametrize("host", ["192.168.1.7:8080", "[fe80::1]:8080", "localhost", socket.gethostname()])
def test_beyond_this_machine_addresses_and_its_own_name_are_served(host: str) -> None:
    assert status(WIDE, host, [], COOKIE) == 0


def test_name_that_was_configured_is_served_and_other_names_are_not() -> None:
    assert status(NAMED, "cell.lab:8080", [], COOKIE) == status(NAMED, "CELL.lab:8080", [], COOKIE) == 0
    assert status(NAMED, "evil.example:8080", [], COOKIE) == HTTPStatus.FORBIDDEN
    assert status(WIDE, "evil.example:8080", [], COOKIE) == HTTPStatus.FORBIDDEN


@pytest.mark.parametrize(("host", "only_here"), [
    ("127.0.0.1", True), ("127.8.9.10", True), ("localhost", True), ("::1", True), ("0.0.0.0", False), ("::", False),
    ("192.168.0.1", False), ("cell.lab", False), ("localhost.evil.example", False), ("", False),
])
def test_only_addresses_of_the_machine_itself_count_as_loopback(host: str, only_here: bool) -> None:
    assert is_loopback(host) is only_here


def test_address_to_open_is_one_that_can_be_opened() -> None:
    assert address_of("127.0.0.1", 8080) == "http://127.0.0.1:8080"
    assert address_of("::1", 8080) == "http://[::1]:8080"
    assert address_of("cell.lab", 80) == "http://cell.lab:80"
    assert "0.0.0.0" not in address_of("0.0.0.0", 8080) and "::" not in address_of("::", 8080)


def test_made_tokens_are_long_differ_and_need_no_escaping() -> None:
    made = {make_token() for _ in range(100)}
    assert len(made) == 100 and all(len(token) >= 40 and TOKEN.fullmatch(token) for token in made)


def test_secret_is_not_in_what_is_logged_of_the_rules() -> None:
    assert SECRET not in repr(WIDE)


@pytest.mark.parametrize(("peer", "passes"), [
    ("127.0.0.1", True), ("127.8.9.1", True), ("::1", True), ("::ffff:127.0.0.1", True), ("172.18.0.1", True),
    ("::ffff:172.18.0.1", True), ("172.18.0.7", False),
    ("::ffff:172.18.0.7", False), ("fe80::1%eth0", False), ("", False),
])
def test_where_no_token_is_asked_for_the_socket_tells_who_is_near_and_not_the_request(peer: str, passes: bool) -> None:
    published = Access("127.0.0.1", 8080, near=frozenset({"172.18.0.1"}))
    answer = published.answer("/", {"host": ["127.0.0.1:8080"]}, upgrade=True, peer=peer)
    assert (answer is None) is passes
    if answer is not None:
        assert answer.status is HTTPStatus.UNAUTHORIZED and "ZENCELL_VIEWER_TOKEN" in answer.text


def test_gateway_of_a_container_is_that_of_its_default_route(tmp_path: Path) -> None:
    table = tmp_path / "route"
    rows = ["Iface Destination Gateway Flags", "eth1 00000000 010012AC 0003", "eth0 000013AC 00000000 0001", ""]
    table.write_text("\n".join(rows).replace(" ", "\t"))
    assert gateways(table) == {"172.18.0.1"}
    assert gateways(tmp_path / "none") == frozenset()


def test_each_token_opens_for_its_role_and_the_one_of_before_for_everything() -> None:
    tokens = {role: f"{role}-token-of-the-page" for role in ROLES}
    access = Access("127.0.0.1", 8080, SECRET, tokens)
    for role, token in tokens.items():
        assert status(access, "127.0.0.1:8080", cookie=f"zencell-8080={token}") == 0
        assert access.roles([f"zencell-8080={token}"]) == {"look", role}
        assert status(access, "127.0.0.1:8080", path=f"/?token={token}") == 0
    assert access.roles([f"zencell-8080={SECRET}"]) == set(ROLES)
    assert not access.roles(["zencell-8080=look", "zencell-8081=" + SECRET])
    assert status(access, "127.0.0.1:8080") == HTTPStatus.UNAUTHORIZED
    assert SECRET not in repr(access) and "of-the-page" not in repr(access)
    assert HERE.roles([]) == set(ROLES)


def test_tokens_of_a_folder_are_those_that_only_its_owner_reads(tmp_path: Path) -> None:
    assert tokens_in(tmp_path, "panda") == {}
    for role in ROLES[:2]:
        write_secret(token_file(tmp_path, "panda", role), f"{role}-token-of-the-page\n".encode())
    assert tokens_in(tmp_path, "panda") == {role: f"{role}-token-of-the-page" for role in ROLES[:2]}
    token_file(tmp_path, "panda", "look").chmod(0o640)
    with pytest.raises(ConfigError, match=r"panda\.page\.look' can be read by others: chmod 600 it"):
        tokens_in(tmp_path, "panda")
    write_secret(token_file(tmp_path, "panda", "look"), b"short\n")
    with pytest.raises(ConfigError, match=r"panda\.page\.look' holds no token"):
        tokens_in(tmp_path, "panda")
