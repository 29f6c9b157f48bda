"""Arrays of pixels: windows, resampling, correlation, contrast."""
