"""The backend `cuda`: the rasterizer of `render.kernels` on an NVIDIA card. Nothing here is imported without one."""
