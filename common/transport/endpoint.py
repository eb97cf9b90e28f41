"""Endpoints of the routers of domains, and the Zenoh configuration that all processes share."""

from __future__ import annotations

import ipaddress
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from common.errors import ConfigError
from common.transport.credentials import SECURE_VARIABLE, Credentials

if TYPE_CHECKING:
    import zenoh

    from common.transport.inner_certificates import InnerAuthority

BASE_PORT = 7447
DEFAULT_DOMAIN = 42
MAX_DOMAIN = 232
DOMAIN_VARIABLE = "ZENCELL_DOMAIN"
CONNECT_VARIABLE = "ZENCELL_CONNECT"
LISTEN_VARIABLE = "ZENCELL_LISTEN"
LINK_VARIABLE = "ZENCELL_LINK"
NEAR_VARIABLE = "ZENCELL_NEAR"  # ENDPOINT=OTHER,OTHER, set by a supervisor for its processes
NEAR_MS = 2000  # of one attempt to connect if there are further endpoints; a loaded machine takes 1 s
LEASE_MS = 2000  # after which a frozen process or cut link is detected
STUCK_MS = 1000  # after which a link that takes nothing is cut
# The same in the router, where all messages of a writer wait meanwhile, several times over: with 300 ms for up to 2 s,
# after which the writer counts as lost. With 30 ms readers were dropped that waited for a processor.
ROUTER_STUCK_MS = 100
LINK_RETRY_MS = (100, 1000)  # first and longest pause between two attempts to reach the router of another host
LARGE_BYTES = 32 * 1024  # from its first larger message on a stream uses the second link: images and clouds
LINKS = ("0-5", "6-7")  # priorities of each link between two sessions: large messages have one of their own
STREAM_BATCHES = 16  # of 64 kB that may wait in a link: an entire image, so that the next message is not dropped
MAX_BYTES = 40 * 1024 * 1024  # of one message; the largest image that is read has 32 MB
MAX_OTHER_BYTES = 8 * 1024 * 1024 + 4096  # of a message without an image: minutes of a trajectory have 1 MB
OVERHEAD_BYTES = 4096  # of a message besides its payload
MAX_SESSIONS = 512  # at one router: 50 cells of ten services
MAX_PENDING = 32  # of these that have not authenticated themselves yet
ACCEPT_MS = 3000  # in which they must; a loaded machine takes 1 s
STATE_BATCHES = 16  # of states and events, the maximum: seconds of them for a reader that is delayed
# Priorities of the small messages of a router. With Zenoh's default of two batches each they are full whenever the
# thread that empties them waits for a processor.
SMALL_PRIORITIES = ("control", "real_time", "interactive_high", "interactive_low", "data_high", "data")
STREAM_WAIT_US = 20_000  # that a stream's message waits for room before it is dropped, once until there is room again
PARTS_WAIT_US = 300_000  # in all, that one of several batches does: a point cloud of 12 MB has 192 of them
# The same in the router, where other readers of these images wait meanwhile: less than the age that makes one stale.
ROUTER_PARTS_WAIT_US = 500_000


def parse_domain(value: object, field: str = "--domain") -> int:
    """Return the domain as a number.

    Raises:
        ConfigError: it is not an integer from 0 to 232.
    """
    try:
        domain = int(str(value))
    except ValueError:
        domain = -1
    if not 0 <= domain <= MAX_DOMAIN:
        raise ConfigError(field, value, f"must be a whole number from 0 to {MAX_DOMAIN}")
    return domain


def port_of(domain: int) -> int:
    """Return the TCP port of a domain's router."""
    return BASE_PORT + domain


def endpoint_of(domain: int | str | None = None, connect: str | None = None,
                environ: Mapping[str, str] = os.environ) -> str:
    """Return the endpoint to connect to, such as tcp/127.0.0.1:7489.

    Args:
        domain: 0 to 232; by default `ZENCELL_DOMAIN`, else 42.
        connect: endpoint of another router, which overrides the domain; by default `ZENCELL_CONNECT`.
        environ: environment variables.

    Raises:
        ConfigError: the domain is out of bounds or the endpoint is malformed.
    """
    field = "--connect" if connect else CONNECT_VARIABLE
    given = connect or ("" if domain is not None else environ.get(CONNECT_VARIABLE, ""))
    if given:
        return _checked_endpoint(field, given)
    protocol = "tls" if environ.get(SECURE_VARIABLE) else "tcp"
    if domain is None:
        number = parse_domain(environ.get(DOMAIN_VARIABLE, DEFAULT_DOMAIN), DOMAIN_VARIABLE)
    else:
        number = parse_domain(domain)
    return f"{protocol}/127.0.0.1:{port_of(number)}"


def _checked_endpoint(field: str, endpoint: str) -> str:
    protocol, slash, address = endpoint.partition("/")
    host, colon, port = address.split("?")[0].split("#")[0].rpartition(":")
    known = protocol in ("tcp", "tls", "quic", "ws", "udp")
    if not (known and slash and colon and host and port.isdigit() and 0 < int(port) < 65536):
        raise ConfigError(field, endpoint, "must be an endpoint such as tcp/192.168.1.10:7447")
    return endpoint


def endpoints_of(field: str, given: Sequence[str], variable: str, environ: Mapping[str, str] = os.environ) -> list[str]:
    """Return the endpoints of an option, else those of a variable, separated by commas.

    Raises:
        ConfigError: one of them is malformed, or is not encrypted in a secured cell.
    """
    if not given:
        field = variable
        given = [text.strip() for text in environ.get(variable, "").split(",") if text.strip()]
    for endpoint in given:
        _checked_endpoint(field, endpoint)
        if environ.get(SECURE_VARIABLE) and not is_encrypted(endpoint):
            raise ConfigError(field, endpoint, "is an open endpoint: with certificates it must be tls/HOST:PORT")
    return list(dict.fromkeys(given))


def listen_endpoints(domain: int, more: Sequence[str]) -> list[str]:
    """Return where the router of a domain listens: at its port for services of its host, and at `more` endpoints."""
    own = endpoint_of(domain)
    port = own.rpartition(":")[2]
    wildcards = [endpoint for endpoint in more if endpoint.rpartition(":")[2] == port and _is_wildcard(endpoint)]
    return [*wildcards, *(e for e in more if e not in wildcards)] if wildcards else list(dict.fromkeys([own, *more]))


def address_of(endpoint: str) -> tuple[str, int]:
    """Return host and port of an endpoint."""
    host, _, port = endpoint.partition("/")[2].split("?")[0].split("#")[0].rpartition(":")
    return host.strip("[]"), int(port)


def peer_group(address: str) -> str:
    """Return what counts as one peer: an IPv4 address, or the network (/64) of an IPv6 address."""
    parsed = ipaddress.ip_address(address.partition("%")[0])
    if isinstance(parsed, ipaddress.IPv6Address):
        return str(parsed.ipv4_mapped or ipaddress.ip_network((parsed.packed[:8] + bytes(8), 64)))
    return str(parsed)


def _host_of(endpoint: str) -> str:
    return endpoint.partition("/")[2].rpartition(":")[0].strip("[]")


def _is_wildcard(endpoint: str) -> bool:
    return _host_of(endpoint) in {"0.0.0.0", "::"}


def is_loopback(endpoint: str) -> bool:
    """Return whether only its own host reaches an endpoint."""
    host = _host_of(endpoint)
    return host in {"localhost", "::1"} or host.startswith("127.")


def is_encrypted(endpoint: str) -> bool:
    """Return whether connections to an endpoint are authenticated and encrypted."""
    return endpoint.startswith(("tls/", "quic/"))


def nearby_endpoints(endpoint: str, environ: Mapping[str, str] = os.environ) -> list[str]:
    """Return the further endpoints of a router for services of its own host, which their supervisor handed down."""
    known, _, near = environ.get(NEAR_VARIABLE, "").partition("=")
    return near.split(",") if near and known == endpoint else []


def client_config(
    endpoint: str, *, connect_ms: int, credentials: Credentials | None = None, two_links: bool = False,
    near: Sequence[str] = (),
) -> zenoh.Config:
    """Return the configuration of a client.

    Args:
        endpoint: of the router.
        connect_ms: for the first connection.
        credentials: of a client of a secured router.
        two_links: open a second link for large messages; the router must admit it, as ours does.
        near: further endpoints of that router; each is tried once, before `endpoint`.
    """
    links: dict[str, Any] = {"connect__endpoints": [*near, endpoint]}
    if two_links:
        links["connect__endpoints"] = [{"strategy": "allOf", "locators": _locators(e)} for e in (*near, endpoint)]
        links["transport__unicast__max_links"] = len(LINKS)
    if near:
        links["transport__unicast__open_timeout"] = NEAR_MS
    return _config(_settings(
        **({"transport__link__tls": credentials.tls()} if credentials else {}),
        **links,
        mode="client",
        listen__endpoints=[],
        connect__timeout_ms=0 if near else connect_ms,  # else Zenoh spends all of it on the first
        connect__retry={"period_init_ms": 20, "period_max_ms": 100, "period_increase_factor": 1.5},
    ))


def _locators(endpoint: str) -> list[str]:
    """Return the endpoint once for each link, unless it declares priorities itself."""
    place, mark, config = endpoint.partition("#")
    if "prio=" in place:
        return [endpoint]
    return [f"{place}{';' if '?' in place else '?'}prio={priorities}{mark}{config}" for priorities in LINKS]


def router_config(
    endpoints: Sequence[str], credentials: Credentials | InnerAuthority | None = None,
    access: dict[str, Any] | None = None, links: Sequence[str] = (), small: Sequence[str] = (),
) -> zenoh.Config:
    """Return the configuration of a router: `router_settings`."""
    return _config(router_settings(endpoints, credentials, access, links, small))


def router_settings(
    endpoints: Sequence[str], credentials: Credentials | InnerAuthority | None = None,
    access: dict[str, Any] | None = None, links: Sequence[str] = (), small: Sequence[str] = (),
) -> dict[str, Any]:
    """Return the settings of a router that differ from Zenoh's defaults, as the tree of a configuration file.

    Args:
        endpoints: the only ones at which it listens.
        credentials: with which it authenticates itself; without them it admits every client.
        access: rules of access control.
        links: endpoints of routers of other hosts, to which it connects again and again.
        small: further keys of small messages, without the cell: remapped keys of topics.
    """
    first_ms, longest_ms = LINK_RETRY_MS
    secure = {"transport__link__tls": credentials.tls(listens=True)} if credentials else {}
    controlled = {"access_control": access} if access else {}
    # Small messages share a batch if they have to wait. Reliable ones wait (`block`): `block_first`, with which a stuck
    # reader does not delay the router, drops each message whose predecessor's thread was not scheduled within the wait
    # of a stream, on an idle machine one of some 20,000.
    shared = {"messages": ["put"], "flows": ["egress"], "overwrite": {"express": False}}
    # Images of clients without a second link.
    large = {
        "messages": ["put"], "flows": ["egress"], "qos": {"congestion_control": "drop"},
        "payload_size": f"{LARGE_BYTES}..", "overwrite": {"express": False, "priority": "data_low"},
    }
    return _settings(
        qos__network=[large, shared],
        transport__link__tx__queue__congestion_control__block__wait_before_close=ROUTER_STUCK_MS * 1000,
        transport__link__tx__queue__congestion_control__drop__max_wait_before_drop_fragments=ROUTER_PARTS_WAIT_US,
        **{f"transport__link__tx__queue__size__{name}": STATE_BATCHES for name in SMALL_PRIORITIES},
        mode="router", listen__endpoints=list(endpoints),
        # One link each: when two were opened at once, neither carried messages in one start of four.
        connect__endpoints=list(links),
        connect__timeout_ms=-1, connect__exit_on_failure=False,
        connect__retry={"period_init_ms": first_ms, "period_max_ms": longest_ms, "period_increase_factor": 1.5},
        low_pass_filter=size_limits(small),
        transport__unicast__max_links=len(LINKS),
        transport__unicast__max_sessions=MAX_SESSIONS,
        transport__unicast__accept_pending=MAX_PENDING,
        transport__unicast__accept_timeout=ACCEPT_MS,
        **secure, **controlled,
    )


def size_limits(more: Sequence[str] = ()) -> list[dict[str, Any]]:
    """Return the router's filters, which drop messages larger than any of their topic; `more`: further keys."""
    from common.application import all_topics

    by_size: dict[int, list[str]] = {}
    for topic in all_topics().values():
        largest = max(topic.message.max_bytes, getattr(topic, "answer", topic.message).max_bytes)
        if (allowed := largest + OVERHEAD_BYTES) <= MAX_OTHER_BYTES:
            by_size.setdefault(allowed, []).append(topic.expression)
    by_size.setdefault(MAX_OTHER_BYTES, []).extend(more)
    return [
        {
            "id": f"at most {size} bytes", "flows": ["ingress"], "messages": ["put", "query", "reply"],
            "key_exprs": sorted(f"*/{key}" for key in keys), "size_limit": size,
        }
        for size, keys in sorted(by_size.items()) if keys
    ]


def remapped_small_keys(tables: Iterable[Mapping[str, str]]) -> list[str]:
    """Return the keys that services of a cell remap topics without images and clouds to, as in common/remapping.py."""
    from common.application import all_topics
    from common.messages import Image, PointCloud2
    from common.remapping import Remapping

    if not (remappings := [Remapping(table) for table in tables if table]):
        return []
    own = [topic.expression for topic in all_topics().values() if topic.message not in (Image, PointCloud2)]
    return sorted({remapping.key(key) for remapping in remappings for key in own}.difference(own))


def _settings(**values: Any) -> dict[str, Any]:
    """Return a tree of settings, with those that all processes share; `__` in a name goes down one level."""
    common = {
        "scouting__multicast__enabled": False,
        "scouting__gossip__enabled": False,
        "timestamping__enabled": True,
        "transport__link__tx__lease": LEASE_MS,
        # A reliable message that a link does not take for this long ends the link. By default it is 5 s, in which Zenoh
        # does not notice that the lease of a frozen router has expired, nor that it is back.
        "transport__link__tx__queue__congestion_control__block__wait_before_close": STUCK_MS * 1000,
        # By default two batches and 1 ms: a busy machine does not take an image then.
        "transport__link__tx__queue__size__data": STREAM_BATCHES,
        "transport__link__tx__queue__size__data_low": STREAM_BATCHES,
        "transport__link__tx__queue__congestion_control__drop__wait_before_drop": STREAM_WAIT_US,
        # By default 50 ms: on a busy machine every second point cloud was dropped.
        "transport__link__tx__queue__congestion_control__drop__max_wait_before_drop_fragments": PARTS_WAIT_US,
        # Shared memory bypasses the size limits of a link, and queries over it were lost when a receiver stalled.
        "transport__shared_memory__enabled": False,
        # A longer message ends its link; by default a message may have 1 GB.
        "transport__link__rx__max_message_size": MAX_BYTES,
    }
    tree: dict[str, Any] = {}
    for path, value in {**common, **values}.items():
        *parents, name = path.split("__")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
        node[name] = value
    return tree


def _config(settings: dict[str, Any]) -> zenoh.Config:
    import zenoh  # slow to import: the command line needs endpoints only

    return zenoh.Config.from_json5(json.dumps(settings))
