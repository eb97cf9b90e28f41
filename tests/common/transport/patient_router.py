"""A router that waits for half a minute until it drops a part of a picture that a reader does not take."""

from common.transport import endpoint
from services.router import main

if __name__ == "__main__":
    endpoint.PARTS_WAIT_US = 30_000_000
    main()
