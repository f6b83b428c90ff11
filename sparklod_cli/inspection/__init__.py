"""What is in a splat file, and whether that is as it should be."""
