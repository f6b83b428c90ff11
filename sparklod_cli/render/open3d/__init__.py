"""The Open3D backend, which draws in a separate process."""
