"""Half-ring calibration of the head."""
