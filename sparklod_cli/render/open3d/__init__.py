"""The Open3D backend, which draws in a process of its own."""
