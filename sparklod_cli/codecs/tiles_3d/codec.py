from .tile_writer import encode_files as encode_files
