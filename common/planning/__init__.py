"""Motion planning: collision world, planners, retiming, validation, pipeline."""
