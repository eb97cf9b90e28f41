"""Where the router of a domain is, and the one configuration of Zenoh that all processes share."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from common.errors import ConfigError
from common.transport.credentials import SECURE_VARIABLE, Credentials

if TYPE_CHECKING:
    import zenoh

BASE_PORT = 7447
DEFAULT_DOMAIN = 42
MAX_DOMAIN = 232
DOMAIN_VARIABLE = "ZENCELL_DOMAIN"
CONNECT_VARIABLE = "ZENCELL_CONNECT"
LISTEN_VARIABLE = "ZENCELL_LISTEN"
LINK_VARIABLE = "ZENCELL_LINK"
NEAR_VARIABLE = "ZENCELL_NEAR"  # ENDPOINT=OTHER,OTHER, set by a supervisor for what it starts
NEAR_MS = 2000  # in which a try to connect ends where there is another way: a loaded machine takes 1 s
LEASE_MS = 2000  # a frozen process or cut link is noticed after this
STUCK_MS = 1000  # so is a link that takes nothing
# The same in the router, where all that comes from the writer waits meanwhile, several times over: with 300 ms for up
# to 2 s, after which it is taken for lost. With 30 ms readers were dropped that waited for a processor.
ROUTER_STUCK_MS = 100
LINK_RETRY_MS = (100, 1000)  # between two tries to reach the router of another host: at first, and at most
LARGE_BYTES = 32 * 1024  # a stream with a larger message travels apart from then on: pictures and clouds
LINKS = ("0-5", "6-7")  # priorities of each link between two: what is large has one of its own
STREAM_BATCHES = 16  # of 64 kB that may wait in a link: a whole picture, so that what follows it is not dropped
MOST_BYTES = 40 * 1024 * 1024  # of one message; the largest picture that is read has 32 MB
MOST_BYTES_BESIDES = 8 * 1024 * 1024 + 4096  # of one that holds no picture: minutes of a trajectory have 1 MB
BESIDE_BYTES = 4096  # that a message may have beside its payload
MOST_SESSIONS = 512  # at one router: 50 cells of ten services
MOST_PENDING = 32  # of these that have not shown who they are yet
ACCEPT_MS = 3000  # in which they must; a loaded machine takes 1 s
STATE_BATCHES = 16  # of states and events, the most there can be: seconds of them for a reader that is held up
# Those of what a router sends that is small; with two batches each, as it comes, they are full wherever the thread that
# empties them waits for a processor.
SMALL_PRIORITIES = ("control", "real_time", "interactive_high", "interactive_low", "data_high", "data")
STREAM_WAIT_US = 20_000  # that a stream's message waits for room before it is dropped, once until there is room again
PARTS_WAIT_US = 300_000  # that one of several batches does, in all: a point cloud of 12 MB has 192 of them
# The same in the router, where other readers of that writer's pictures wait meanwhile: less than makes a picture old.
ROUTER_PARTS_WAIT_US = 500_000


def parse_domain(value: object, field: str = "--domain") -> int:
    """The domain as a number.

    Raises:
        ConfigError: it is not a whole number from 0 to 232.
    """
    try:
        domain = int(str(value))
    except ValueError:
        domain = -1
    if not 0 <= domain <= MAX_DOMAIN:
        raise ConfigError(field, value, f"must be a whole number from 0 to {MAX_DOMAIN}")
    return domain


def port_of(domain: int) -> int:
    """The TCP port of a domain's router."""
    return BASE_PORT + domain


def endpoint_of(domain: int | str | None = None, connect: str | None = None,
                environ: Mapping[str, str] = os.environ) -> str:
    """The endpoint to connect to, such as tcp/127.0.0.1:7489.

    Args:
        domain: 0 to 232; when not given `ZENCELL_DOMAIN`, else 42.
        connect: an endpoint of someone else's router, which wins over the domain; when not given `ZENCELL_CONNECT`.
        environ: where the variables are looked up.

    Raises:
        ConfigError: the domain is out of bounds or the endpoint is not one.
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
    """The endpoints that were given to an option, else those of a variable, which stand there with commas between.

    Raises:
        ConfigError: one of them is not an endpoint, or goes without TLS in a secured cell.
    """
    if not given:
        field = variable
        given = [text.strip() for text in environ.get(variable, "").split(",") if text.strip()]
    for endpoint in given:
        _checked_endpoint(field, endpoint)
        if environ.get(SECURE_VARIABLE) and not endpoint.startswith(("tls/", "quic/")):
            raise ConfigError(field, endpoint, "is an open endpoint: with certificates it must be tls/HOST:PORT")
    return list(dict.fromkeys(given))


def listening(domain: int, wider: Sequence[str]) -> list[str]:
    """Where the router of a domain listens: at its own port for the services of its host, and wherever else it must."""
    own = endpoint_of(domain)
    port = own.rpartition(":")[2]
    every = [endpoint for endpoint in wider if endpoint.rpartition(":")[2] == port and is_any(endpoint)]
    return [*every, *(e for e in wider if e not in every)] if every else list(dict.fromkeys([own, *wider]))


def address_of(endpoint: str) -> tuple[str, int]:
    """Host and port of an endpoint."""
    host, _, port = endpoint.partition("/")[2].split("?")[0].split("#")[0].rpartition(":")
    return host.strip("[]"), int(port)


def is_any(endpoint: str) -> bool:
    """Whether it stands for all addresses of a host."""
    return endpoint.partition("/")[2].rpartition(":")[0].strip("[]") in {"0.0.0.0", "::"}


def is_loopback(endpoint: str) -> bool:
    """Whether an endpoint is reached from its own host only."""
    host = endpoint.partition("/")[2].rpartition(":")[0].strip("[]")
    return host in {"localhost", "::1"} or host.startswith("127.")


def is_encrypted(endpoint: str) -> bool:
    """Whether both ends of a connection prove who they are there, and nobody between them can read."""
    return endpoint.startswith(("tls/", "quic/"))


def near_of(endpoint: str, environ: Mapping[str, str] = os.environ) -> list[str]:
    """Where the router of an endpoint listens for the services of its own host besides, as their supervisor says."""
    known, _, near = environ.get(NEAR_VARIABLE, "").partition("=")
    return near.split(",") if near and known == endpoint else []


def client_config(
    endpoint: str, *, connect_ms: int, credentials: Credentials | None = None, apart: bool = False,
    near: Sequence[str] = (),
) -> zenoh.Config:
    """Configuration of a client of the router at an endpoint, which tries for `connect_ms` to reach it at first.

    With `apart` it has a link of its own for what is large; the router must admit that, as ours does. With other
    endpoints of that router, that are `near`, each is tried once, these first.
    """
    links: dict[str, Any] = {"connect__endpoints": [*near, endpoint]}
    if apart:
        links["connect__endpoints"] = [{"strategy": "allOf", "locators": _apart(each)} for each in (*near, endpoint)]
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


def _apart(endpoint: str) -> list[str]:
    """The endpoint once for each link, unless it says itself what travels there."""
    place, mark, config = endpoint.partition("#")
    if "prio=" in place:
        return [endpoint]
    return [f"{place}{';' if '?' in place else '?'}prio={priorities}{mark}{config}" for priorities in LINKS]


def router_config(
    endpoints: Sequence[str], credentials: Credentials | None = None, access: dict[str, Any] | None = None,
    links: Sequence[str] = (), small: Sequence[str] = (),
) -> zenoh.Config:
    """Configuration of a router that listens at these endpoints only: that of `router_settings`."""
    return _config(router_settings(endpoints, credentials, access, links, small))


def router_settings(
    endpoints: Sequence[str], credentials: Credentials | None = None, access: dict[str, Any] | None = None,
    links: Sequence[str] = (), small: Sequence[str] = (),
) -> dict[str, Any]:
    """What a router is told, as the tree of a Zenoh configuration file; all else is as Zenoh has it.

    Args:
        endpoints: where.
        credentials: with which it proves itself; without them everybody is let in.
        access: who may do what.
        links: endpoints of routers of other hosts, which it tries to reach for as long as it runs.
        small: more keys under which nothing large travels, without the cell: `small_keys` under other names.
    """
    first, most = LINK_RETRY_MS
    secure = {"transport__link__tls": credentials.tls(listens=True)} if credentials else {}
    controlled = {"access_control": access} if access else {}
    # Small messages share a batch where they have to wait. What must arrive does wait (`block`): `block_first`, which
    # keeps a reader that takes nothing from holding up the router, drops each message whose predecessor's thread was
    # not scheduled within the time that a stream waits, on an idle machine one of some 20,000.
    shared = {"messages": ["put"], "flows": ["egress"], "overwrite": {"express": False}}
    # Pictures of those who know nothing of a link for what is large.
    apart = {
        "messages": ["put"], "flows": ["egress"], "qos": {"congestion_control": "drop"},
        "payload_size": f"{LARGE_BYTES}..", "overwrite": {"express": False, "priority": "data_low"},
    }
    return _settings(
        qos__network=[apart, shared],
        transport__link__tx__queue__congestion_control__block__wait_before_close=ROUTER_STUCK_MS * 1000,
        transport__link__tx__queue__congestion_control__drop__max_wait_before_drop_fragments=ROUTER_PARTS_WAIT_US,
        **{f"transport__link__tx__queue__size__{name}": STATE_BATCHES for name in SMALL_PRIORITIES},
        mode="router", listen__endpoints=list(endpoints),
        # One link each: where two were opened at once, nothing travelled over either in one start of four.
        connect__endpoints=list(links),
        connect__timeout_ms=-1, connect__exit_on_failure=False,
        connect__retry={"period_init_ms": first, "period_max_ms": most, "period_increase_factor": 1.5},
        low_pass_filter=size_limits(small),
        transport__unicast__max_links=len(LINKS),
        transport__unicast__max_sessions=MOST_SESSIONS,
        transport__unicast__accept_pending=MOST_PENDING,
        transport__unicast__accept_timeout=ACCEPT_MS,
        **secure, **controlled,
    )


def size_limits(more: Sequence[str] = ()) -> list[dict[str, Any]]:
    """What the router drops, because it is larger than any message of its topic ever is; `more` keys beside our own."""
    from common.application import all_topics

    by_size: dict[int, list[str]] = {}
    for topic in all_topics().values():
        most = max(topic.message.most_bytes, getattr(topic, "answer", topic.message).most_bytes)
        if (allowed := most + BESIDE_BYTES) <= MOST_BYTES_BESIDES:
            by_size.setdefault(allowed, []).append(topic.expression)
    by_size.setdefault(MOST_BYTES_BESIDES, []).extend(more)
    return [
        {
            "id": f"at most {size} bytes", "flows": ["ingress"], "messages": ["put", "query", "reply"],
            "key_exprs": sorted(f"*/{key}" for key in keys), "size_limit": size,
        }
        for size, keys in sorted(by_size.items()) if keys
    ]


def small_keys() -> list[str]:
    """Keys of all topics whose messages are neither pictures nor clouds."""
    from common.application import all_topics
    from common.messages import Image, PointCloud2

    return [topic.expression for topic in all_topics().values() if topic.message not in (Image, PointCloud2)]


def small_keys_renamed(tables: Iterable[Mapping[str, str]]) -> list[str]:
    """The same under the other names that services give them, as common/remapping.py has it."""
    from common.remapping import Remapping

    if not (given := [Remapping(table) for table in tables if table]):
        return []
    own = small_keys()
    return sorted({names.key(key) for names in given for key in own}.difference(own))


def _settings(**values: Any) -> dict[str, Any]:
    """A tree of settings, those that all processes share among them; `__` in a name goes down one level."""
    common = {
        "scouting__multicast__enabled": False,
        "scouting__gossip__enabled": False,
        "timestamping__enabled": True,
        "transport__link__tx__lease": LEASE_MS,
        # A message that must arrive and that a link does not take for so long ends the link. By default it is 5 s, and
        # Zenoh does not see meanwhile that the lease of a frozen router has run out, nor that it is back.
        "transport__link__tx__queue__congestion_control__block__wait_before_close": STUCK_MS * 1000,
        # By default two batches and 1 ms: a busy machine does not take a picture then.
        "transport__link__tx__queue__size__data": STREAM_BATCHES,
        "transport__link__tx__queue__size__data_low": STREAM_BATCHES,
        "transport__link__tx__queue__congestion_control__drop__wait_before_drop": STREAM_WAIT_US,
        # By default 50 ms: on a busy machine every second point cloud was dropped.
        "transport__link__tx__queue__congestion_control__drop__max_wait_before_drop_fragments": PARTS_WAIT_US,
        # Shared memory goes round the size limits of a link, and queries over it were lost when a receiver stalled.
        "transport__shared_memory__enabled": False,
        # What is longer ends the link that it comes from; by default a message may have 1 GB.
        "transport__link__rx__max_message_size": MOST_BYTES,
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
    import zenoh  # here: the command line asks for endpoints before it has started anything

    return zenoh.Config.from_json5(json.dumps(settings))
