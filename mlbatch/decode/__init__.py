"""Raw columns of a window to the points of a scan."""
