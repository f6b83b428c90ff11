"""Builders and traversal of Level-of-Detail trees."""
