"""Cameras, and where they are on their way through a scene."""
