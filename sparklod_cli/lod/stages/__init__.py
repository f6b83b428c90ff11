"""Builders in stages: a tree made block by block, where the whole scene does not fit into memory."""
