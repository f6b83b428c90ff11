"""Scenes where they stand: files read once each, what a camera sees of them, and the splats of that.

The one loader of scenes that are viewed, and the one way from a cut to splats: traversals, pictures and
comparisons all go through it.
"""
