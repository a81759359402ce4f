"""The profile, the sample points, and functions that OpenCL and NumPy compute to the same bit."""
