"""Tilesets of 3D Tiles as they are read."""

VERSION, REPLACE, CONTENT_GLTF = "1.1", "REPLACE", "3DTILES_content_gltf"
MAX_TILESET, NESTED = 1 << 25, ".json"


def parse(data):
    raise OSError
