"""Elevation models: terrain, coregistration, differences, mosaics."""
