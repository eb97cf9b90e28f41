"""The codec `msgpack` of zenoh-cli; importing it through this package makes the project importable."""

from common.client.json_codec import decode, encode

__all__ = ["decode", "encode"]
