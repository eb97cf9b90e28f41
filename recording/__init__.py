"""Recordings: MCAP files of the messages of a cell, byte for byte. See https://mcap.dev/spec.

Each key and writer has a channel with message encoding `msgpack` and the JSON schema of the message class. The log time
is the time of arrival, the publish time the stamp of the header, the sequence number that of the writer.
"""
