"""The cell as nodes of ROS 2, without ROS: keys, tokens and messages of rmw_zenoh."""
