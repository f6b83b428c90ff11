"""The backend `osmesa`: draws splats with OpenGL, as viewers in browsers do, without a window or a graphics card.

The pipeline is antimatter15's: splats in an integer texture, an instance of one quad for each, the nearest first, and
blending from front to back. Splats look as in the other backends.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..codecs import layouts
from ..model.falloff import HALF_LOG2E, LEAST_EXPONENT, LEAST_REST, MAX_STD_DEV, MIN_ALPHA, STD_DEV_PER_D
from ..model.sh import COEFFICIENTS
from ..model.splats import FloatArray, Splats
from ..system.errors import BackendError, optional_import
from . import opengl
from .kernels.ellipse import LEAST_COVARIANCE, MAX_D, MAX_VARIANCE
from .kernels.project import MAX_COLOR
from .rasterizer import Image, ShadedSplats, world_to_camera
from .render_settings import BLUR, CLIP, RasterSettings

Words = NDArray[np.uint32]
Indices = NDArray[np.uint32]


def _in_sight(
    splats: ShadedSplats, u: FloatArray, v: FloatArray, depth: FloatArray, camera: Camera, raster: RasterSettings
) -> Indices:
    """Return indices of the splats whose centres the vertex shader does not cull, with a small margin."""
    seen = (depth > raster.near) & (depth < raster.far) & (splats.lod_opacity >= np.float32(MIN_ALPHA))
    for across, focal, principal, pixels in zip(
        (u, v), camera.focal, camera.principal, (camera.width, camera.height), strict=True
    ):
        # Times the depth, from the middle of the picture.
        off = np.abs(np.float32(focal) * across + np.float32(principal - pixels / 2) * depth)
        seen &= off <= np.float32(1.0001 * CLIP * pixels / 2) * depth
    return np.flatnonzero(seen).astype(np.uint32)


def sort_exact(key: FloatArray) -> NDArray[np.int64]:
    """Return (N,) indices sorted by (N,) float32 keys, equal keys by descending index, as in Spark.

    Sorts 64-bit numbers of key and index, which is several times faster than sorting indices.
    """
    bits = (key + np.float32(0)).view(np.uint32)  # -0 equals 0
    # Flips the bits that make negative floats sort in reverse.
    ordered = bits ^ np.where(bits >> 31, np.uint32(0xFFFFFFFF), np.uint32(0x80000000))
    both = (ordered.astype(np.uint64) << np.uint64(32)) | np.arange(len(key), dtype=np.uint64)[::-1]
    both.sort()
    return len(key) - 1 - (both & np.uint64(0xFFFFFFFF)).astype(np.int64)


def sort_counting16(key: FloatArray) -> NDArray[np.int64]:
    """Return (N,) indices sorted by (N,) float32 keys quantized to 65,536 steps; within a step by descending index."""
    if not len(key):
        return np.zeros(0, np.int64)
    above = key.astype(np.float64) - float(key.min())
    step = (above * (65535 / (above.max() or 1))).astype(np.uint16)
    return len(key) - 1 - np.argsort(step[::-1], kind="stable")  # numpy sorts uint16 by radix


SORT = {"exact": sort_exact, "counting16": sort_counting16}


#: A quad as a triangle fan; the splat's ellipse ends at 2.
CORNERS = np.array([[-2, -2], [2, -2], [2, 2], [-2, 2]], np.float32)

_T = TypeVar("_T")


def draw(splats: ShadedSplats, camera: Camera, raster: RasterSettings, **options: Any) -> Image:
    """Draw the picture of a camera, see `rasterizer.draw`; `options` are those of `OpenGLRenderer`.

    `BackendError` if OpenGL is not available, or the picture or the scene exceeds its limits.
    """
    return _renderer(**options).draw(splats, camera, raster)


class OpenGLRenderer:
    """Draws a sequence of frames; compiles once, uploads what has changed, and sorts when the order has changed.

    Args:
        precision: one of `PRECISIONS`.
        sorting: one of `render_settings.SORTINGS`.
        throttle: splats are sorted again only when the cosine between the camera's direction at the last sort and its
            current direction is at most 1 - throttle; antimatter15's viewer uses 0.01, an angle of 8.1 degrees. 0 sorts
            for each frame. With `RasterSettings.sort` "radial", which depends on the camera's position, splats are
            also sorted when it has moved so far that the splat of median distance appears rotated by that angle.
    """

    def __init__(self, *, precision: str = "float", sorting: str = "exact", throttle: float = 0.0) -> None:
        self._pack, self._sort, self._throttle = PRECISIONS[precision], SORT[sorting], throttle
        self.uploads = self.sorts = 0
        self._count, self._capacity, self._size = 0, 0, (0, 0)
        self._last: ShadedSplats | None = None
        #: Camera and settings of the last sort, and the median of what splats were sorted by.
        self._sorted: tuple[Camera, RasterSettings, float] | None = None
        self._texture: Any = None
        self._target: Any = None
        self._indices: Any = None
        self._array: Any = None
        on_gl_thread(self._compile, precision)

    def draw(self, splats: ShadedSplats, camera: Camera, raster: RasterSettings) -> Image:
        return on_gl_thread(self._draw, splats, camera, raster)

    def _compile(self, precision: str) -> None:
        self._context = open_context()
        self._program = self._context.program(**sources(precision))
        self._corners = self._context.buffer(CORNERS.tobytes())

    def _draw(self, splats: ShadedSplats, camera: Camera, raster: RasterSettings) -> Image:
        self._context.gc()
        self._upload(splats)
        if not self._is_sorted(camera, raster):
            self._write_order(splats, camera, raster)
        self._resize(camera.width, camera.height)
        self._target.use()
        self._target.clear()
        if self._count:
            self._set_uniforms(camera, raster)
            self._texture.use(0)
            self._context.enable_only(self._context.BLEND)
            self._context.blend_func = self._context.ONE_MINUS_DST_ALPHA, self._context.ONE
            self._array.render(self._context.TRIANGLE_FAN, vertices=4, instances=self._count)
        image = np.empty((camera.height, camera.width, 4), np.float32)
        self._target.read_into(image, components=4, dtype="f4")
        self._check("drawing")
        return image

    def _upload(self, splats: ShadedSplats) -> None:
        before, self._last = self._last, splats
        moved = before is None or not _is_same(before, splats, GEOMETRY)
        if moved:
            self._sorted = None
        elif before is not None and self._texture is not None and _is_same(before, splats, ("rgb",)):
            return
        texture = self._pack(splats)
        height, width = texture.shape[:2]
        if self._texture is None or self._texture.height != height:
            self._texture = None  # and stays so after a scene that is too large
            self._check_edge(max(height, width), f"{len(splats):,} splats")
            self._texture = self._context.texture((width, height), 4, dtype="u4")
            self._texture.filter = self._context.NEAREST, self._context.NEAREST
            self._check(f"a texture for {len(splats):,} splats")
        self._texture.write(texture)
        self.uploads += 1

    def _is_sorted(self, camera: Camera, raster: RasterSettings) -> bool:
        """Return whether the order of the last sort is still valid."""
        if self._sorted is None or not self._throttle:
            return False
        last, settings, middle = self._sorted
        if raster.sort != settings.sort or 1 - float(camera.forward @ last.forward) >= self._throttle:
            return False
        if raster.sort != "radial":
            return True  # moving the camera adds the same to all depths
        return float(np.linalg.norm(camera.position - last.position)) < np.sqrt(2 * self._throttle) * middle

    def _write_order(self, splats: ShadedSplats, camera: Camera, raster: RasterSettings) -> None:
        """Sort the splats that may be visible from near to far, and upload their indices."""
        with np.errstate(over="ignore", invalid="ignore"):  # splats that far away are not drawn
            x, y, z = splats.center.T
            # Right, down and forward, rounded as in the rasterizer's kernel.
            u, v, depth = (row[0] * x + row[1] * y + row[2] * z + row[3] for row in world_to_camera(camera))
            key = np.sqrt(u * u + v * v + depth * depth) if raster.sort == "radial" else depth
            if self._throttle:  # splats that are invisible now may be visible when this order is reused
                seen = np.flatnonzero(np.isfinite(key)).astype(np.uint32)
            else:
                seen = _in_sight(splats, u, v, depth, camera, raster)
        key = key[seen]
        self._sorted = camera, raster, float(np.median(np.abs(key))) if len(key) else 0.0
        indices = seen[self._sort(key)]
        self.sorts += 1
        self._count = len(indices)
        if self._array is None or self._capacity < len(splats):
            self._capacity = max(1, len(splats))
            self._indices = self._context.buffer(reserve=4 * self._capacity, dynamic=True)
            content = [(self._corners, "2f", "corner"), (self._indices, "1u/i", "index")]
            self._array = self._context.vertex_array(self._program, content)
        self._indices.orphan()
        self._indices.write(indices)

    def _resize(self, width: int, height: int) -> None:
        if self._size == (width, height):
            return
        self._target, self._size = None, (0, 0)
        self._check_edge(max(width, height), f"{width} x {height} pixels")
        self._target = self._context.framebuffer([self._context.renderbuffer((width, height), 4, dtype="f4")])
        self._check(f"a picture of {width} x {height} pixels")
        self._size = width, height

    def _set_uniforms(self, camera: Camera, raster: RasterSettings) -> None:
        uniforms = {
            "world_to_camera": tuple(world_to_camera(camera).T.ravel()),
            "focal": camera.focal,
            "principal": camera.principal,
            "size": (camera.width, camera.height),
            "range": (raster.near, raster.far),
            "max_radius": raster.max_radius,
            "shifted": raster.profile == "shifted",
        }
        for name, value in uniforms.items():
            self._program[name] = value

    def _check_edge(self, edge: int, what: str) -> None:
        most = self._context.info["GL_MAX_TEXTURE_SIZE"]
        if edge > most:
            raise BackendError(f"{what} exceed the limit of this OpenGL, {most} along an edge; use the backend numba")

    def _check(self, what: str) -> None:
        error = self._context.error
        if error != "GL_NO_ERROR":
            raise BackendError(f"OpenGL failed at {what}: {error}; try the backend numba")


_renderer = functools.lru_cache(maxsize=2)(OpenGLRenderer)


def on_gl_thread(work: Callable[..., _T], *arguments: Any) -> _T:
    """Run a function on the thread that makes all calls to OpenGL.

    A thread has one current context. On a thread of its own, ours cannot interfere with that of VTK, for example, which
    otherwise draws nothing, or into another context.
    """
    thread, process = _thread()
    if process != os.getpid():  # Mesa's threads do not survive a fork, and it would wait for them forever
        raise BackendError("OpenGL cannot be used in a forked process; start processes with spawn instead of fork")
    try:
        return thread.submit(work, *arguments).result()
    except Exception as error:
        if type(error).__module__.lstrip("_") == "moderngl":  # which may not be installed
            message = str(error).split("\n")[0]
            raise BackendError(f"OpenGL failed to draw ({message}); try the backend numba") from error
        raise


@functools.cache
def _thread() -> tuple[ThreadPoolExecutor, int]:
    return ThreadPoolExecutor(1, "sparklod-gl"), os.getpid()


@functools.cache
def open_context() -> Any:
    """Return the moderngl.Context of this process, to be called and used `on_gl_thread` only.

    `BackendError`, with the packages to install, if OpenGL is not available.
    """
    with optional_import("the backend osmesa needs moderngl", "render", BackendError, package="moderngl"):
        import moderngl  # noqa: F401
    reasons = []
    for kind in opengl.PACKAGES:
        reason = opengl.probe(kind)
        if not reason:
            try:
                return opengl.create(kind)
            except opengl.NoContextError as error:
                reason = str(error)
        reasons.append(f"{kind}: {reason}")
    packages = " or ".join(opengl.PACKAGES.values())
    raise BackendError(
        f"the backend osmesa finds no OpenGL (on Debian and Ubuntu: apt install {packages}; {'; '.join(reasons)})"
    )


def _glsl_constants(**values: float) -> str:
    """Return declarations of float32 constants in all their digits."""
    texts = {name: f"{np.float32(value):.9g}" for name, value in values.items()}
    return "".join(
        f"const float {name} = {text if '.' in text or 'e' in text else f'{text}.0'};\n" for name, text in texts.items()
    )


#: GLSL of `model.falloff`: `deviations_of`, the root of `end_of`, and the alpha of a splat by z^2.
_FALLOFF = f"""
{
    _glsl_constants(
        LEAST_EXPONENT=float(LEAST_EXPONENT),
        LEAST_REST=float(LEAST_REST),
        MAX_STD_DEV=MAX_STD_DEV,
        MIN_ALPHA=MIN_ALPHA,
        MINUS_HALF_LOG2E=-float(HALF_LOG2E),
        STD_DEV_PER_D=STD_DEV_PER_D,
    )
}
const int ROOT_HALF = 0x3F3504F3;  // the bits of sqrt(1 / 2)

// As in the rasterizer: exact to a factor of 4e-7 even near 1, where logarithms of drivers need not be.
float log2_exactly(float v) {{
    int bits = floatBitsToInt(v), whole = (bits - ROOT_HALF) >> 23;
    float m = intBitsToFloat(bits - (whole << 23));  // from sqrt(1 / 2) to sqrt(2)
    precise float s = (m - 1.0) / (m + 1.0), q = s * s;
    float p = 0.41219858;
    p = p * q + 0.57707802;
    p = p * q + 0.96179669;
    p = p * q + 2.8853901;
    return float(whole) + s * p;
}}

float alpha_at(float z2, float d, float power, bool shifted) {{
    if (d <= 1.0) return d * exp2(MINUS_HALF_LOG2E * z2);
    if (shifted) {{
        float beyond = max(sqrt(max(z2, 0.0)) - (d - 1.0), 0.0);
        return exp2(MINUS_HALF_LOG2E * d * beyond * beyond);
    }}
    float rest = max(1.0 - exp2(MINUS_HALF_LOG2E * z2), LEAST_REST);
    return 1.0 - exp2(max(power * log2_exactly(rest), LEAST_EXPONENT));
}}

float deviations_of(float d) {{
    return MAX_STD_DEV + STD_DEV_PER_D * max(d - 1.0, 0.0);
}}

float edge_of(float d, float deviations) {{
    return d <= 1.0 ? min(deviations, sqrt(2.0 * log(d / MIN_ALPHA))) : deviations;
}}
"""

_CONSTANTS = _glsl_constants(
    BLUR=BLUR,
    CLIP=CLIP,
    E=np.e,
    LEAST_COVARIANCE=float(LEAST_COVARIANCE),
    MAX_D=float(MAX_D),
    MAX_VARIANCE=float(MAX_VARIANCE),
)

#: The splat that the vertex shader draws.
_SPLAT = """
uniform usampler2D data;
vec3 center, rgb, scale;
vec4 quat;
float lod_opacity;
mat3 covariance;
"""

#: GLSL that reads a splat of `float_texture`, and computes its covariance on the screen.
_FLOATS = """
const int TEXELS = 4, ROW_BITS = 11;

void fetch(ivec2 at) {
    uvec4 first = texelFetch(data, at, 0);
    center = uintBitsToFloat(first.xyz);
    lod_opacity = uintBitsToFloat(first.w);
    quat = uintBitsToFloat(texelFetch(data, at + ivec2(1, 0), 0));
    scale = uintBitsToFloat(texelFetch(data, at + ivec2(2, 0), 0).xyz);
    rgb = uintBitsToFloat(texelFetch(data, at + ivec2(3, 0), 0).xyz);
}

// t and s are the rows of the Jacobian of the projection, times the rotation into the camera.
vec4 on_screen(vec3 t, vec3 s) {
    float x = quat.x, y = quat.y, z = quat.z, w = quat.w;
    precise vec3 r0 = vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y));
    precise vec3 r1 = vec3(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x));
    precise vec3 r2 = vec3(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y));
    precise vec3 p = (t.x * r0 + t.y * r1 + t.z * r2) * scale;
    precise vec3 q = (s.x * r0 + s.y * r1 + s.z * r2) * scale;
    precise vec3 n = vec3(p.x * q.y - p.y * q.x, p.x * q.z - p.z * q.x, p.y * q.z - p.z * q.y);
    precise vec4 c = vec4(
        p.x * p.x + p.y * p.y + p.z * p.z,
        p.x * q.x + p.y * q.y + p.z * q.z,
        q.x * q.x + q.y * q.y + q.z * q.z,
        n.x * n.x + n.y * n.y + n.z * n.z
    );
    return c;
}
"""

#: GLSL that does the same for `half_texture`.
_HALVES = """
const int TEXELS = 2, ROW_BITS = 10;

void fetch(ivec2 at) {
    uvec4 first = texelFetch(data, at, 0), second = texelFetch(data, at + ivec2(1, 0), 0);
    center = uintBitsToFloat(first.xyz);
    vec2 more = unpackHalf2x16(first.w);
    lod_opacity = more.x;
    vec2 a = unpackHalf2x16(second.x), b = unpackHalf2x16(second.y), c = unpackHalf2x16(second.z);
    covariance = mat3(a.x, a.y, b.x, a.y, b.y, c.x, b.x, c.x, c.y) / 4.0;
    rgb = more.y * unpackUnorm4x8(second.w).rgb;
}

vec4 on_screen(vec3 t, vec3 s) {
    vec3 v = covariance * s;
    float xx = dot(t, covariance * t), xy = dot(t, v), yy = dot(s, v);
    return vec4(xx, xy, yy, max(xx * yy - xy * xy, 0.0));
}
"""

_VERTEX = """
uniform mat4x3 world_to_camera;  // into axes with y down, looking along z
uniform vec2 focal, principal, size;  // pixels
uniform vec2 range;  // near and far
uniform float max_radius;  // pixels

in vec2 corner;  // -2 or 2
in uint index;

flat out vec2 middle;  // pixels from the upper left corner
flat out vec3 conic;  // z^2 = A dx^2 + 2 B dx dy + C dy^2, how many standard deviations away a pixel is, squared
flat out vec2 end_opacity;  // where that ends, and D
flat out vec4 rgb_power;  // colour, and exp((D^2 - 1) / e) above 1

void main() {
    gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // behind the far plane, so not drawn, unless overwritten below
    int i = int(index);
    fetch(ivec2((i & ((1 << ROW_BITS) - 1)) * TEXELS, i >> ROW_BITS));
    mat4x3 m = world_to_camera;
    precise vec3 place = m[0] * center.x + m[1] * center.y + m[2] * center.z + m[3];
    float d = min(lod_opacity, MAX_D);
    if (!(place.z > range.x && place.z < range.y && d >= MIN_ALPHA)) return;
    precise float inverse = 1.0 / place.z;
    precise vec2 offset = focal * place.xy * inverse;
    precise vec2 half_size = 0.5 * size;
    if (any(greaterThan(abs(principal + offset - half_size), CLIP * half_size))) return;

    precise vec2 j = focal * inverse, k = -offset * inverse;
    vec3 ahead = vec3(m[0].z, m[1].z, m[2].z);
    precise vec3 t = j.x * vec3(m[0].x, m[1].x, m[2].x) + k.x * ahead;
    precise vec3 s = j.y * vec3(m[0].y, m[1].y, m[2].y) + k.y * ahead;
    vec4 c = on_screen(t, s);  // xx, xy, yy, and the determinant
    // Sums of non-negative terms: c.x * c.z - c.y * c.y would cancel the determinants of needles.
    precise float before = c.w, det = before + BLUR * (c.x + c.z) + BLUR * BLUR;
    precise float xx = c.x + BLUR, yy = c.z + BLUR, xy = c.y;
    if (!(det > 0.0 && xx < MAX_VARIANCE && yy < MAX_VARIANCE)) return;
    float deviations = deviations_of(d);
    d *= sqrt(before / det);
    if (!(d >= MIN_ALPHA)) return;

    precise float mean = 0.5 * (xx + yy);
    precise float spread = sqrt(max(mean * mean - det, 0.0));
    if (deviations * sqrt(mean + spread) > max_radius) {  // shorten each axis by itself
        precise vec2 axis = xx >= yy ? vec2(1.0, 0.0) : vec2(0.0, 1.0);
        if (abs(xy) > LEAST_COVARIANCE) axis = vec2(xy, mean + spread - xx);
        precise float norm = 1.0 / sqrt(axis.x * axis.x + axis.y * axis.y);
        precise float ax = axis.x * norm, ay = axis.y * norm;
        precise float most = max_radius / deviations;
        precise float first = most * most, second = min(first, det / (mean + spread));
        xx = first * ax * ax + second * ay * ay;
        xy = (first - second) * ax * ay;
        yy = first * ay * ay + second * ax * ax;
        det = first * second;
        if (!(det > 0.0)) return;
    }
    middle = principal + offset;
    conic = vec3(yy, -xy, xx) / det;
    end_opacity = vec2(deviations * deviations, d);
    rgb_power = vec4(rgb, d > 1.0 ? exp((d * d - 1.0) / E) : 1.0);

    // The quad lies along the axes of the ellipse. It only bounds the pixels, so it may be a little larger, which makes
    // up for corners being rounded to parts of a pixel.
    float half_difference = 0.5 * (xx - yy);
    float reach = length(vec2(half_difference, xy));
    float greatest = 0.5 * (xx + yy) + reach;
    vec2 along = xx >= yy ? vec2(half_difference + reach, xy) : vec2(xy, reach - half_difference);
    along = reach > 0.0 ? normalize(along) : vec2(1.0, 0.0);
    // It ends where the splat ends, or earlier where the splat is too faint to be drawn.
    float edge = edge_of(d, deviations);
    vec2 sides = 0.5 * (edge * sqrt(vec2(greatest, det / greatest)) * 1.001 + 0.02);
    vec2 at = middle + corner.x * sides.x * along + corner.y * sides.y * vec2(-along.y, along.x);
    gl_Position = vec4(2.0 * at / size - 1.0, 0.0, 1.0);  // y down: the first row read back is the picture's uppermost
}
"""

_FRAGMENT = """
uniform bool shifted;

flat in vec2 middle;
flat in vec3 conic;
flat in vec2 end_opacity;
flat in vec4 rgb_power;

out vec4 color;

void main() {
    vec2 off = gl_FragCoord.xy - middle;
    float z2 = (conic.x * off.x + 2.0 * conic.y * off.y) * off.x + conic.z * off.y * off.y;
    if (z2 > end_opacity.x) discard;
    float alpha = alpha_at(z2, end_opacity.y, rgb_power.w, shifted);
    if (alpha < MIN_ALPHA) discard;
    color = vec4(min(alpha * rgb_power.rgb, 1.0), alpha);
}
"""


def sources(precision: str) -> dict[str, str]:
    """Return the sources of the shaders for a data texture of one of `PRECISIONS`."""
    head = f"#version 420 core\n{_CONSTANTS}{_FALLOFF}\n"
    vertex = head + _SPLAT + {"float": _FLOATS, "half": _HALVES}[precision] + _VERTEX
    return {"vertex_shader": vertex, "fragment_shader": head + _FRAGMENT}


#: Columns of `ShadedSplats` that do not change when the camera moves; colours do if there are spherical harmonics.
GEOMETRY = ("center", "scale", "quat_xyzw", "lod_opacity")

#: Splats in a row of `float_texture`, a power of two, and the four texels of each.
FLOATS_A_ROW = 2048
FLOATS = np.dtype(
    [
        ("center", "<f4", 3),  # 0: world units
        ("lod_opacity", "<f4"),  # 12: D
        ("quat_xyzw", "<f4", 4),  # 16: local to world
        ("scale", "<f4", 3),  # 32: world units
        ("unused_a", "<u4"),  # 44: 0
        ("rgb", "<f4", 3),  # 48
        ("unused_b", "<u4"),  # 60: 0
    ]
)
assert FLOATS.itemsize == 64


def float_texture(shaded: ShadedSplats) -> Words:
    """Pack splats into (H, 4 * `FLOATS_A_ROW`, 4) uint32, row by row, with zeros after the last splat.

    The texture has rotations and scales instead of covariances, in which float32 would lose the short axis of a thin
    splat. In whole texels this takes no more space than the six elements of a covariance.
    """
    texture = np.zeros((max(1, -(-len(shaded) // FLOATS_A_ROW)), 4 * FLOATS_A_ROW, 4), np.uint32)
    rows = texture.reshape(-1, 16).view(FLOATS)[: len(shaded), 0]
    for name in GEOMETRY:
        rows[name] = getattr(shaded, name)
    rows["rgb"] = _clamped_colors(shaded)
    return texture


def half_texture(shaded: ShadedSplats) -> Words:
    """Pack splats into the texture of antimatter15's viewer, see `codecs.layouts`.

    A byte can store neither the opacity of a merged splat nor a colour above 1. So the word that the viewer leaves
    unused holds two float16: D, and a factor for the colour bytes, usually 1.
    """
    rgb = _clamped_colors(shaded)
    gain = np.maximum(rgb.max(axis=1, initial=0), 1).astype(np.float16)
    # float16 may round the factor down, and a byte must not overflow.
    rgb = np.minimum(rgb / gain[:, None].astype(np.float32), 1)
    opacity, sh = np.minimum(shaded.lod_opacity, 1), np.zeros((len(shaded), COEFFICIENTS[0], 3), np.float32)
    splats = Splats(shaded.center, shaded.scale, shaded.quat_xyzw, opacity, rgb, sh)
    texture = layouts.pack_texture(splats)["texture"]
    texture.reshape(-1, 8).view(np.float16)[: len(shaded), 6:8] = np.stack([shaded.lod_opacity, gain], axis=1)
    return texture


#: Precisions of the stored splats, float32 or that of antimatter15's viewer, and the functions that pack these.
PRECISIONS = {"float": float_texture, "half": half_texture}


def _clamped_colors(shaded: ShadedSplats) -> FloatArray:
    """Return (N, 3) colours clamped to the range of the rasterizer; NaN becomes 0."""
    rgb: FloatArray = np.where(shaded.rgb > 0, np.minimum(shaded.rgb, MAX_COLOR), np.float32(0))
    return rgb


def _is_same(one: ShadedSplats, other: ShadedSplats, columns: tuple[str, ...]) -> bool:
    """Compare columns by value, since every frame has new arrays, mostly with the same values."""
    return all(
        (mine := getattr(one, name)) is (theirs := getattr(other, name)) or np.array_equal(mine, theirs)
        for name in columns
    )
