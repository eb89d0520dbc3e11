"""ROS nodes, one file each: parameters, callbacks, error mapping; nothing computed here."""
