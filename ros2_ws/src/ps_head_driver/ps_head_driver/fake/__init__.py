"""Fake hardware, one level below the driver: a firmware emulator, and the light that it makes."""
