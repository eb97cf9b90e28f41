"""The network: sessions, bus, codec, requests, liveliness. The only importer of Zenoh, and its in-process twin."""
