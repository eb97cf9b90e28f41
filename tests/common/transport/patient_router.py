"""A router that waits 90 s for a slow reader before it drops a fragment of an image."""

from common.transport import endpoint
from services.router import main

if __name__ == "__main__":
    endpoint.ROUTER_PARTS_WAIT_US = 90_000_000
    main()
