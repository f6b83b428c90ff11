"""Pictures of structure: scenes in 3D, charts."""
