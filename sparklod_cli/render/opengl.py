"""OpenGL without a window: a moderngl context over libOSMesa or, if that is missing, over EGL.

Run as a module with the name of a library, it tests the library by drawing. A broken driver ends this separate process.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import functools
import struct
import subprocess
import sys
from typing import Any

from ..system.python_process import module_command

#: OpenGL version of the shaders: 4.2 introduced unpackHalf2x16.
VERSION = 420

#: Libraries for a context, in order of preference, and their Debian and Ubuntu packages.
PACKAGES = {"osmesa": "libosmesa6", "egl": "libegl1 libgl1 libgl1-mesa-dri"}

#: File names of libOSMesa; Mesa 25.0 is the last release with it.
OSMESA_NAMES = ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so")

#: Time limit in seconds for testing a context; Mesa compiles its first shaders in well under one.
PATIENCE = 60

# GL/osmesa.h
_FORMAT, _DEPTH_BITS, _STENCIL_BITS, _PROFILE, _CORE_PROFILE = 0x22, 0x30, 0x31, 0x33, 0x34
_MAJOR_VERSION, _MINOR_VERSION = 0x36, 0x37
_RGBA, _UNSIGNED_BYTE = 0x1908, 0x1401


class NoContextError(Exception):
    """No context can be created, for the reason in the message."""


class OSMesa:
    """A context of libOSMesa for moderngl, which requires the method `load_opengl_function`.

    The context is current on the thread that created it. Pictures are drawn to framebuffer objects, not to its default
    framebuffer of 1 x 1 pixels.
    """

    def __init__(self) -> None:
        reason = ""
        for library in OSMESA_NAMES:
            try:
                self._library: Any = ctypes.CDLL(library)
                break
            except OSError as error:
                reason = reason or str(error)
        else:
            raise NoContextError(reason)
        for name in ("OSMesaCreateContextAttribs", "OSMesaGetProcAddress"):
            if not hasattr(self._library, name):
                raise NoContextError(f"this libOSMesa is too old: it has no {name}")
            getattr(self._library, name).restype = ctypes.c_void_p
        attributes = [_FORMAT, _RGBA, _DEPTH_BITS, 0, _STENCIL_BITS, 0, _PROFILE, _CORE_PROFILE]
        attributes += [_MAJOR_VERSION, VERSION // 100, _MINOR_VERSION, VERSION // 10 % 10, 0]
        create = self._library.OSMesaCreateContextAttribs
        self._context = ctypes.c_void_p(create((ctypes.c_int * len(attributes))(*attributes), ctypes.c_void_p()))
        self._pixel = (ctypes.c_ubyte * 4)()  # written by the library while the context is current
        if not self._context:
            raise NoContextError(f"this libOSMesa has no OpenGL {VERSION // 100}.{VERSION // 10 % 10}")
        if not self._library.OSMesaMakeCurrent(self._context, self._pixel, _UNSIGNED_BYTE, 1, 1):
            raise NoContextError("libOSMesa does not make its context current")

    def load_opengl_function(self, name: str) -> int:
        """Return the address of an OpenGL function, or 0."""
        return self._library.OSMesaGetProcAddress(name.encode()) or 0

    def release(self) -> None:
        """Free the context, which must be current."""
        self._library.OSMesaMakeCurrent(None, None, _UNSIGNED_BYTE, 0, 0)
        self._library.OSMesaDestroyContext(self._context)


def create(kind: str) -> Any:
    """Create a moderngl.Context over one of `PACKAGES`, current on this thread; `NoContextError` if that fails.

    `probe` first, because a broken driver may end the process.
    """
    try:
        import moderngl

        options: Any  # some are missing in moderngl's type hints
        if kind == "osmesa":
            options = {"context": OSMesa()}
        else:
            # glcontext's default file names are those of development packages; with glvnd either library will do.
            libgl = ctypes.util.find_library("GL") or ctypes.util.find_library("OpenGL") or "libGL.so.1"
            libegl = ctypes.util.find_library("EGL") or "libEGL.so.1"
            options = {"backend": "egl", "libgl": libgl, "libegl": libegl, "standalone": True}
        context = moderngl.create_context(require=VERSION, **options)
        # OpenGL objects must be freed on this thread, by `gc`; Python frees objects on any thread.
        context.gc_mode = "context_gc"
        return context
    except NoContextError:
        raise
    except Exception as error:  # moderngl and glcontext raise plain exceptions
        raise NoContextError(str(error) or type(error).__name__) from None


@functools.cache
def probe(kind: str) -> str:
    """Test a context in a separate process; return the reason why it does not work, or an empty text."""
    command = module_command(__name__, kind)
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    except (OSError, subprocess.SubprocessError) as error:
        return str(error)
    if child.returncode == 0:
        return ""
    lines = child.stderr.strip().splitlines()
    if child.returncode < 0:
        return f"the driver ended the test process by signal {-child.returncode}"
    return lines[-1] if lines else f"the test failed with exit code {child.returncode}"


_VERTEX = """
#version 420 core
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }
"""

_FRAGMENT = """
#version 420 core
out vec4 color;
void main() { color = vec4(0.25, 0.5, 2.0, 1.0); }
"""


def _try(kind: str) -> None:
    """Draw a triangle to a float texture, and check the result."""
    import moderngl

    context = create(kind)
    target = context.framebuffer([context.texture((8, 8), 4, dtype="f4")])
    target.use()
    target.clear()
    program = context.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
    context.vertex_array(program, []).render(moderngl.TRIANGLES, vertices=3)
    seen = struct.unpack("4f", target.read(components=4, dtype="f4")[:16])
    if seen != (0.25, 0.5, 2.0, 1.0):
        raise NoContextError(f"a triangle came out as {seen}")


if __name__ == "__main__":
    try:
        _try(sys.argv[1])
    except Exception as error:
        sys.exit(str(error) or type(error).__name__)
