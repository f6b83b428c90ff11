"""Baking scenes that are larger than memory: blocks on disk, a stage for each, and a tree that joins them."""
