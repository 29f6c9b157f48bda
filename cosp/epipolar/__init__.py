"""Epipolar rectification of a stereo pair; of the camera it knows two mappings between film and ground."""
