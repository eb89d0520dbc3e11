"""Command-line tools, one file each; the same code as the nodes."""
