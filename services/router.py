"""The router of a domain, as a process: `python -m services.router --domain 42`."""

from common.transport.router import main

if __name__ == "__main__":
    main()
