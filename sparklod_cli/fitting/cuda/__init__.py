"""Steps of the optimiser on an NVIDIA card. Nothing here is imported without one."""
