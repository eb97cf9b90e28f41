"""Recordings: MCAP files of what travelled in a cell, byte for byte. See https://mcap.dev/spec.

One channel for each key and writer, message encoding `msgpack`, schema the JSON schema of the message class; the log
time is when a message arrived, the publish time the stamp of its header, the sequence number the writer's own.
"""
