"""Groups of options that commands share, each of which gives one frozen dataclass."""
