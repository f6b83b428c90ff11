"""Formats of camera paths, a module each; none imports another."""
