"""Compiled parts of fitting: visible nodes, differences of pictures, and steps of the optimiser."""
