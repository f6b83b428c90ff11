"""Laws of builders in stages."""
