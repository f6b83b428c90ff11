"""Reports on splat files, and checks of them."""
