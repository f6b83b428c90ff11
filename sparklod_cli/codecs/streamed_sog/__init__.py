"""Streamed SOG, a folder of SOG chunks at several detail levels: `codec` reads and writes it."""
