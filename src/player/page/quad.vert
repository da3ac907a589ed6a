#version 300 es
// Places one rectangle of pixels per Gaussian, in the order of `id`.
precision highp float;
precision highp int;
precision highp usampler2D;

layout(location = 0) in uint id;
uniform usampler2D form;
uniform usampler2D reach;
uniform usampler2D colour;
uniform vec2 size;
flat out vec4 shape;
flat out vec2 fade;
flat out vec3 ink;

void main() {
    ivec2 at = ivec2(id & 2047u, id >> 11);
    uvec4 bounds = texelFetch(reach, at, 0);
    uvec2 from = bounds.zw & 0xffffu, to = bounds.zw >> 16;
    shape = uintBitsToFloat(texelFetch(form, at, 0));
    fade = uintBitsToFloat(bounds.xy);
    ink = uintBitsToFloat(texelFetch(colour, at, 0).xyz);
    vec2 corner = vec2((gl_VertexID & 1) == 0 ? from.x : to.x, gl_VertexID < 2 ? from.y : to.y);
    // Rows of an image run down, rows of the window run up.
    gl_Position = vec4(2.0 * corner.x / size.x - 1.0, 1.0 - 2.0 * corner.y / size.y, 0.0, 1.0);
}
