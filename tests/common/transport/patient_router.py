"""A router that waits for a minute and a half until it drops a part of a picture that a reader does not take."""

from common.transport import endpoint
from services.router import main

if __name__ == "__main__":
    endpoint.ROUTER_PARTS_WAIT_US = 90_000_000
    main()
