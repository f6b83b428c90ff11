"""The data texture, texels of four 32-bit words, and the shaders that read splats from it.

The shaders, in GLSL 4.2, are kernels/ellipse.py and kernels/raster.py, step by step. `precise` keeps compilers from
reordering: the covariances of thin splats end as small differences of large numbers, which come out visibly different
when rounded in another order.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...codecs.gpu import data_texture
from ...model.falloff import GLSL, glsl_constants
from ...model.sh import COEFFICIENTS
from ...model.splats import FloatArray, Splats
from ..kernels.ellipse import LEAST_COVARIANCE, MAX_D, MAX_VARIANCE
from ..kernels.project import MAX_COLOR
from ..rasterizer import ShadedSplats
from ..settings import BLUR, CLIP

_CONSTANTS = glsl_constants(
    BLUR=BLUR,
    CLIP=CLIP,
    E=np.e,
    LEAST_COVARIANCE=float(LEAST_COVARIANCE),
    MAX_D=float(MAX_D),
    MAX_VARIANCE=float(MAX_VARIANCE),
)

#: Gets a splat out of the texels of `Floats`, and its covariance on the screen.
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

#: The same for `Halves`.
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
uniform usampler2D data;
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

vec3 center, rgb, scale;
vec4 quat;
float lod_opacity;
mat3 covariance;

void main() {
    gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // behind the far plane: not drawn, unless it is put elsewhere
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
    // Sums of what is not negative: c.x * c.z - c.y * c.y would leave nothing of the determinants of needles.
    precise float before = c.w, det = before + BLUR * (c.x + c.z) + BLUR * BLUR;
    precise float xx = c.x + BLUR, yy = c.z + BLUR, xy = c.y;
    if (!(det > 0.0 && xx < MAX_VARIANCE && yy < MAX_VARIANCE)) return;
    float deviations = deviations_of(d);
    d *= sqrt(before / det);
    if (!(d >= MIN_ALPHA)) return;

    precise float mean = 0.5 * (xx + yy);
    precise float spread = sqrt(max(mean * mean - det, 0.0));
    if (deviations * sqrt(mean + spread) > max_radius) {  // squeezed, each axis by itself
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

    // The quad lies along the axes of the ellipse. It only says which pixels to look at, so a little more of it does no
    // harm, and makes up for corners being rounded to parts of a pixel.
    float half_difference = 0.5 * (xx - yy);
    float reach = length(vec2(half_difference, xy));
    float greatest = 0.5 * (xx + yy) + reach;
    vec2 along = xx >= yy ? vec2(half_difference + reach, xy) : vec2(xy, reach - half_difference);
    along = reach > 0.0 ? normalize(along) : vec2(1.0, 0.0);
    // It ends where the splat gets too faint to be drawn, if that is nearer than its end.
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

_FETCH = {"float": _FLOATS, "half": _HALVES}


def sources(precision: str) -> dict[str, str]:
    """Return the sources of the shaders for a data texture of one of `texture.PRECISIONS`."""
    head = f"#version 420 core\n{_CONSTANTS}{GLSL}\n"
    declarations, main = _VERTEX.split("void main()")
    vertex = head + declarations + _FETCH[precision] + "void main()" + main
    return {"vertex_shader": vertex, "fragment_shader": head + _FRAGMENT}


#: Precision of the stored splats: float32, or that of antimatter15's viewer.
PRECISIONS = ("float", "half")

#: Columns of `ShadedSplats` that do not change when the camera moves; colours do if there are spherical harmonics.
GEOMETRY = ("center", "scale", "quat_xyzw", "lod_opacity")

Words = NDArray[np.uint32]


class DataTexture(ABC):
    """The texels of the last splats, cached so that unchanged parts are not computed or uploaded again.

    `texture` is (height, splats_a_row * texels_a_splat, 4) uint32, row by row from splat 0; unused texels are 0.
    `splats_a_row` is a power of two.
    """

    texels_a_splat: int
    splats_a_row: int

    def __init__(self) -> None:
        self.texture: Words = np.zeros((0, self.splats_a_row * self.texels_a_splat, 4), np.uint32)
        self._last: ShadedSplats | None = None

    def update(self, shaded: ShadedSplats) -> tuple[bool, bool]:
        """Update the texture; return whether it has changed, and whether anything but colours has.

        Compares values, not array identity: every frame has new arrays, mostly with the same values.
        """
        before, self._last = self._last, shaded
        moved = before is None or not _same(before, shaded, GEOMETRY)
        if moved:
            height = max(1, -(-len(shaded) // self.splats_a_row))
            if len(self.texture) != height:
                self.texture = np.zeros((height, *self.texture.shape[1:]), np.uint32)
            self._geometry(shaded)
        recolored = moved or before is None or not _same(before, shaded, ("rgb",))
        if recolored:
            self._colors(shaded)
        return recolored, moved

    def _rows(self, kind: np.dtype[Any], count: int) -> NDArray[Any]:
        return self.texture.reshape(-1, 4 * self.texels_a_splat).view(kind)[:count, 0]

    @abstractmethod
    def _geometry(self, shaded: ShadedSplats) -> None:
        """Write all but the colours."""

    @abstractmethod
    def _colors(self, shaded: ShadedSplats) -> None:
        """Write the colours."""


class Floats(DataTexture):
    """Four texels per splat, in float32.

    Stores rotation and scale instead of the covariance, in which float32 would lose the short axis of a thin splat. In
    whole texels this takes no more space than the six elements of the covariance.
    """

    RECORD = np.dtype(
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
    assert RECORD.itemsize == 64

    texels_a_splat, splats_a_row = 4, 2048

    def _geometry(self, shaded: ShadedSplats) -> None:
        rows = self._rows(self.RECORD, len(shaded))
        for name in GEOMETRY:
            rows[name] = getattr(shaded, name)

    def _colors(self, shaded: ShadedSplats) -> None:
        self._rows(self.RECORD, len(shaded))["rgb"] = _clamped_colors(shaded)


class Halves(DataTexture):
    """Two texels per splat, in the layout of antimatter15's viewer: `codecs.gpu.data_texture`.

    A byte cannot store the opacity of a merged splat, nor a colour above 1. So the word that the viewer leaves unused
    holds two float16: D, and a factor for the colour bytes, usually 1.
    """

    texels_a_splat, splats_a_row = 2, data_texture.SPLATS_A_ROW

    def _geometry(self, shaded: ShadedSplats) -> None:
        colorless = np.zeros_like(shaded.rgb)
        sh = np.zeros((len(shaded), COEFFICIENTS[0], 3), np.float32)
        opacity = np.minimum(shaded.lod_opacity, 1)
        splats = Splats(shaded.center, shaded.scale, shaded.quat_xyzw, opacity, colorless, sh)
        self.texture = data_texture.pack(splats)["texture"]
        self._extra(shaded)[:, 0] = shaded.lod_opacity

    def _colors(self, shaded: ShadedSplats) -> None:
        rgb = _clamped_colors(shaded)
        gain = np.maximum(rgb.max(axis=1, initial=0), 1).astype(np.float16)
        # float16 may round the factor down, and a byte must not overflow.
        bright = np.minimum(rgb / gain[:, None].astype(np.float32), 1)
        self._rows(data_texture.SPLAT, len(shaded))["rgba"][:, :3] = np.rint(bright * 255)
        self._extra(shaded)[:, 1] = gain

    def _extra(self, shaded: ShadedSplats) -> NDArray[np.float16]:
        """Return (N, 2) the two halves of the word that the viewer leaves unused."""
        words: NDArray[np.float16] = self.texture.reshape(-1, 8).view(np.float16)[: len(shaded), 6:8]
        return words


def data_texture_of(precision: str) -> DataTexture:
    """Return an empty data texture of one of `PRECISIONS`."""
    return {"float": Floats, "half": Halves}[precision]()


def _clamped_colors(shaded: ShadedSplats) -> FloatArray:
    """Return (N, 3) colours clamped to the range of the rasterizer; NaN becomes 0."""
    rgb: FloatArray = np.where(shaded.rgb > 0, np.minimum(shaded.rgb, MAX_COLOR), np.float32(0))
    return rgb


def _same(one: ShadedSplats, other: ShadedSplats, columns: tuple[str, ...]) -> bool:
    return all(
        (mine := getattr(one, name)) is (theirs := getattr(other, name)) or np.array_equal(mine, theirs)
        for name in columns
    )
