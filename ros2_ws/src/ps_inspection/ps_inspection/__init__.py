"""The inspection cell: launch, configuration, sessions, demo."""
