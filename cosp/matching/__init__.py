"""Matching and control: where film lies on the ground, ground control points, tie points."""
