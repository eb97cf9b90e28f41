"""The operator's page: a 3D scene and panels, shown by viser. Knows messages and configuration, not the network."""
