"""Disparity of every pixel of a rectified pair: census cost, semi-global aggregation, coarse to fine.

Two pictures, left and right, whose conjugate points lie on the same row; right column = left column + disparity.
"""
