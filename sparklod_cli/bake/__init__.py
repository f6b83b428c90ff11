"""Baking: from splat files to a Level-of-Detail file."""
