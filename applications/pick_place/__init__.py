"""Pick and place: objects that a camera saw are taken from a table into a container."""

TASK = "smart_pick_place"
GRASPS = FILLS = True
FOR_ANY_TASK = True  # older cell files name no application: their own tasks wrote `pick_place_status`
