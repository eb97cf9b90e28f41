"""A cell on the WebSocket protocol of Foxglove: topics as channels, task commands as services, parameters."""
