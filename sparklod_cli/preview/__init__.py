"""Pictures of scenes and of their cuts, as a viewer draws them, and how far a cut is from full detail."""
