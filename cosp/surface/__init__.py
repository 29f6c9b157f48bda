"""From conjugate film points to heights: intersection, gridding, orthophoto."""
