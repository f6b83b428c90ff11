"""The OpenGL of the backend osmesa: a context without a window, the data texture, the shaders, the order."""
