"""Rules of Spark, PlayCanvas and Cesium: the cuts that they draw, their chunks, and the network."""
