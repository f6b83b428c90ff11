"""Cameras: poses, paths, generators, and framing."""
