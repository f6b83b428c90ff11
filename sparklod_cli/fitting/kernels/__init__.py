"""Compiled parts of fitting: what a camera sees of nodes, differences of pictures, and steps of the optimiser."""
