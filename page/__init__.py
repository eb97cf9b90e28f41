"""The operator's page: a 3D scene and panels, displayed by viser."""
