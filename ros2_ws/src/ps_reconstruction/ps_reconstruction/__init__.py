"""Photometric stereo: normals, slopes, albedo, height, surface measures."""
