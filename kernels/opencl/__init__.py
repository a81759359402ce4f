"""OpenCL on this machine: drivers, the device that is used, and what to do where none works."""
