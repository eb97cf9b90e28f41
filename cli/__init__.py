"""The `zencell` command, and the codec for zenoh-cli."""
