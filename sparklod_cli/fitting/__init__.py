"""Fits the merged splats of a finished tree to pictures of full detail: begin with `fit.fit`.

`settings` says what can be chosen and what is reported. Imports nothing heavy.
"""
