"""The data model: splats, scenes, trees, and what is done to them before anything is encoded, drawn or measured."""
