import json
from pathlib import Path
from typing import Any

import pytest
import zenoh

from common.application import all_topics
from common.errors import ConfigError
from common.messages.basics import MAX_PAYLOAD_BYTES
from common.transport.endpoint import OVERHEAD_BYTES, endpoint_of, size_limits


@pytest.mark.parametrize(("domain", "connect", "environ", "endpoint"), [
    (None, None, {}, "tcp/127.0.0.1:7489"),
    (0, None, {}, "tcp/127.0.0.1:7447"),
    ("232", None, {}, "tcp/127.0.0.1:7679"),
    (None, None, {"ZENCELL_DOMAIN": "7"}, "tcp/127.0.0.1:7454"),
    (5, None, {"ZENCELL_DOMAIN": "7"}, "tcp/127.0.0.1:7452"),
    (None, None, {"ZENCELL_DOMAIN": "7", "ZENCELL_CONNECT": "tcp/router:7447"}, "tcp/router:7447"),
    (5, None, {"ZENCELL_CONNECT": "tcp/router:7447"}, "tcp/127.0.0.1:7452"),
    (5, "tls/[::1]:7447", {}, "tls/[::1]:7447"),
])
def test_options_take_precedence_over_the_environment(domain, connect: str | None, environ, endpoint: str) -> None:
    assert endpoint_of(domain, connect, environ) == endpoint


@pytest.mark.parametrize(("arguments", "reason"), [
    *(({"domain": value}, r"--domain: .* must be a whole number from 0 to 232") for value in (-1, 233, "x", "4.5", "")),
    *(({"connect": value}, "--connect: ") for value in (
        "router", "tcp/router", "router:7447", "tcp/:7447", "tcp/router:99999", "x/y:1")),
    ({"environ": {"ZENCELL_DOMAIN": "999"}}, "ZENCELL_DOMAIN: '999'"),
    ({"environ": {"ZENCELL_CONNECT": "here"}}, "ZENCELL_CONNECT: 'here'"),
])
def test_invalid_domain_or_endpoint_is_refused_with_its_source(arguments: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        endpoint_of(**arguments)


def test_client_file_names_the_default_router_and_disables_scouting() -> None:
    config = zenoh.Config.from_file(Path(__file__).parents[3] / "config" / "zenoh-client.json5")
    assert json.loads(config.get_json("mode")) == "client"
    assert json.loads(config.get_json("connect/endpoints")) == [endpoint_of(environ={})]
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False


def test_size_limits_of_the_router_are_those_of_readers() -> None:
    limits = {key: entry["size_limit"] for entry in size_limits() for key in entry["key_exprs"]}
    for topic in all_topics().values():
        most = max(topic.message.max_bytes, getattr(topic, "answer", topic.message).max_bytes)
        if most < MAX_PAYLOAD_BYTES:
            assert limits[f"*/{topic.expression}"] == most + OVERHEAD_BYTES
    assert limits["*/joint_states"] < 32 * 1024 < limits["*/planning_scene"] < limits["*/motion/execute"]
