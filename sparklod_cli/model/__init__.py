"""What splats, scenes and Level-of-Detail trees are, whatever file they come from."""
