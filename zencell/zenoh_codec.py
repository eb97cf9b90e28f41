"""Where zenoh-cli finds the codec `msgpack`: the package is imported first, and with it the project can be."""

from common.client.json_codec import decode, encode

__all__ = ["decode", "encode"]
