#version 300 es
// Computes the footprint of one Gaussian per texel, as crates/splat-render/src/project.rs and color.rs do: same near plane, widening,
// clamping of the directions, tiles within 3 sigma, and smallest alpha.
precision highp float;
precision highp int;
precision highp isampler2DArray;

uniform highp sampler2D place;      // x y z, opacity
uniform highp sampler2D turn;       // quaternion w x y z
uniform highp sampler2D extent;     // logarithms of scales
uniform isampler2DArray harmonics;  // four numbers a layer: coefficient 0 red, green, blue, coefficient 1 red, …
uniform float harmonicStep;
uniform mat3 rows;                  // column k is row k of the rotation from world to camera
uniform vec3 eye;
uniform vec2 focal;
uniform vec2 principal;             // where the optical axis lands when pixel centers are integers
uniform vec2 slopeLimit;
uniform vec2 size;
uniform float near;

layout(location = 0) out uvec4 form;    // u v narrow slope
layout(location = 1) out uvec4 reach;   // fall opacity, pixels x0 | x1 << 16, y0 | y1 << 16
layout(location = 2) out uvec4 colour;  // red green blue

const float DILATION = 0.3;
const float MIN_ALPHA = 1.0 / 255.0;
const float TILE = 16.0;
const float LOG2_E = 1.4426950408889634;
const float LN_2 = 0.6931471805599453;

vec3 shade(ivec2 at, vec3 d) {
    float v[4 * LAYERS];
    for (int layer = 0; layer < LAYERS; layer++) {
        vec4 four = vec4(texelFetch(harmonics, ivec3(at, layer), 0));
        v[4 * layer] = four.x;
        v[4 * layer + 1] = four.y;
        v[4 * layer + 2] = four.z;
        v[4 * layer + 3] = four.w;
    }
#define C(k) vec3(v[3 * (k)], v[3 * (k) + 1], v[3 * (k) + 2])
    vec3 sum = 0.28209479177387814 * C(0);
#if DEGREE > 0
    float x = d.x, y = d.y, z = d.z;
    sum += 0.4886025 * (-y * C(1) + z * C(2) - x * C(3));
#endif
#if DEGREE > 1
    float xx = x * x, yy = y * y, zz = z * z;
    sum += 1.0925485 * (x * y * C(4) - y * z * C(5) - x * z * C(7))
        + 0.31539157 * (2.0 * zz - xx - yy) * C(6) + 0.5462742 * (xx - yy) * C(8);
#endif
#if DEGREE > 2
    sum += -0.5900436 * (y * (3.0 * xx - yy) * C(9) + x * (xx - 3.0 * yy) * C(15))
        + 2.8906114 * x * y * z * C(10)
        - 0.4570458 * (4.0 * zz - xx - yy) * (y * C(11) + x * C(13))
        + 0.37317634 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * C(12)
        + 1.4453057 * z * (xx - yy) * C(14);
#endif
    return max(0.5 + harmonicStep * sum, 0.0);
}

// Returns the pixels [start, stop) along one axis on which a Gaussian with its center at `at` is drawn: in tiles that reach within
// `radius` of the center, at most `half_` away from it, and within the image of `end` pixels.
vec2 span(float at, float radius, float half_, float end) {
    float start = max(floor((at - radius) / TILE) * TILE, ceil(at - half_));
    float stop = min(floor((at + radius + TILE - 1.0) / TILE) * TILE, floor(at + half_) + 1.0);
    return clamp(vec2(start, stop), 0.0, end);
}

void main() {
    ivec2 at = ivec2(gl_FragCoord.xy);
    form = reach = colour = uvec4(0);
    vec4 p = texelFetch(place, at, 0);
    float opacity = p.w;
    vec3 ray = p.xyz - eye;
    vec3 seen = ray * rows;
    float z = seen.z;
    if (!(z > near) || opacity < MIN_ALPHA) return;

    vec2 slopes = seen.xy / z;
    vec2 centre = focal * slopes + principal;
    vec2 k = clamp(slopes, -slopeLimit, slopeLimit);
    vec2 j = focal / z;
    vec3 toU = j.x * (rows[0] - k.x * rows[2]);
    vec3 toV = j.y * (rows[1] - k.y * rows[2]);

    vec4 q = texelFetch(turn, at, 0);
    float s = 2.0 / max(dot(q, q), 1e-30);
    float w = q.x, x = q.y, y = q.z, v = q.w;
    mat3 axes = mat3(
        1.0 - s * (y * y + v * v), s * (x * y + w * v), s * (x * v - w * y),
        s * (x * y - w * v), 1.0 - s * (x * x + v * v), s * (y * v + w * x),
        s * (x * v + w * y), s * (y * v - w * x), 1.0 - s * (x * x + y * y));
    vec3 scale = exp(texelFetch(extent, at, 0).xyz);
    vec3 a = (toU * axes) * scale;
    vec3 b = (toV * axes) * scale;
    float aa = dot(a, a), bb = dot(b, b), xy = dot(a, b);
    vec3 c = cross(a, b);
    float xx = aa + DILATION, yy = bb + DILATION;
    float det = dot(c, c) + DILATION * (aa + bb) + DILATION * DILATION;

    float spread = 0.25 * (xx - yy) * (xx - yy) + xy * xy;
    float radius = ceil(3.0 * sqrt(0.5 * (xx + yy) + sqrt(max(spread, 0.1))));
    float root = sqrt(log2(opacity / MIN_ALPHA) + 1e-3);
    vec2 across = span(centre.x, radius, root * sqrt(2.0 * LN_2 * xx), size.x);
    vec2 down = span(centre.y, radius, root * sqrt(2.0 * LN_2 * yy), size.y);
    float narrow = 0.5 * LOG2_E * yy / det;
    if (!(across.x < across.y && down.x < down.y) || !(narrow < 1e30)) return;

    form = floatBitsToUint(vec4(centre, narrow, xy / yy));
    uvec2 columns = uvec2(across), lines = uvec2(down);
    reach = uvec4(floatBitsToUint(0.5 * LOG2_E / yy), floatBitsToUint(opacity),
                  columns.x | columns.y << 16, lines.x | lines.y << 16);
    colour = uvec4(floatBitsToUint(shade(at, normalize(ray))), 0u);
}
