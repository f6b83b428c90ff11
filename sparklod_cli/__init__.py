"""sparklod: bakes Level-of-Detail trees for 3D Gaussian splat scenes."""

__version__ = "0.1.0"
