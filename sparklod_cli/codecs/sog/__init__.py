"""SOG, the file of PlayCanvas: `codec` reads and writes it, the others are its parts."""
