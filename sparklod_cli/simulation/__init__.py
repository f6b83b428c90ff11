"""Simulation of a viewer along a camera path: budgeted cuts, frame by frame, and their costs."""
