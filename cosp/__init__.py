"""CoSP: measured terrain from the panoramic stereo films of the Corona KH-4, KH-4A and KH-4B cameras."""
