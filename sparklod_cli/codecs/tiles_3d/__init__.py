"""3D Tiles, a tileset.json and binary glTF files of splats at several levels of detail: `codec` reads and writes it."""
