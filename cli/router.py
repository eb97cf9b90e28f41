"""What a cell's router is told, for a router that is not the project's own."""

from __future__ import annotations

import json
import os

from cli import options
from cli.target import CommandGroup
from common.supervision.multi_host import HostOptions
from common.terminal import echo

app = CommandGroup("What a cell's router is told.")

HEAD = "// A router for work cells, as `zencell up` would start it: zenohd --config THIS_FILE\n"


@app.command()
def config(
    domain: options.Domain = None,
    listen: options.Listen = None,
    link: options.Link = None,
    secure: options.Secure = None,
) -> None:
    """Print the router's configuration as JSON5, for zenohd or the image eclipse/zenoh."""
    from common.supervision.launch import Launch
    from common.transport.credentials import ROUTER_NAME, credentials_of, read_access, secure_folder
    from common.transport.endpoint import (
        DEFAULT_DOMAIN,
        DOMAIN_VARIABLE,
        endpoint_of,
        parse_domain,
        router_settings,
    )
    from security.checking import require_valid
    from security.requiring import choose

    choose(secure)
    given = os.environ.get(DOMAIN_VARIABLE, DEFAULT_DOMAIN) if domain is None else domain
    number = parse_domain(given, DOMAIN_VARIABLE if domain is None else "--domain")
    launch = HostOptions(listen, link).linked(Launch(cell="", domain=number))
    endpoints = launch.listen or (endpoint_of(number),)
    folder = secure_folder()
    if folder is None:
        settings = router_settings(endpoints, links=launch.link)
    else:
        require_valid(folder, [ROUTER_NAME], f"zencell secure init {folder} --renew")
        settings = router_settings(endpoints, credentials_of(ROUTER_NAME, folder), read_access(folder), launch.link)
    echo(HEAD + json.dumps(settings, indent=1))
