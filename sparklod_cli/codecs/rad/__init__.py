"""RAD, the file of Spark 2: `codec` reads and writes it, the others are its parts."""
