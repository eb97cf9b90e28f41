"""From an accepted request to set-points: controller, goals, checks, stops. The arm itself is in common/hardware."""
