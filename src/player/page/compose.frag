#version 300 es
// Copies finished images to the canvas: one, two with a border between them, or their difference.
precision highp float;

uniform highp sampler2D left;
uniform highp sampler2D right;
uniform vec2 corner;      // lower left corner of the images on the canvas
uniform float cut;        // column of the images from which the right one is shown
uniform float gain;       // if above 0, the difference of the images times this is shown
out vec4 paint;

void main() {
    vec2 at = gl_FragCoord.xy - corner;
    vec3 a = texelFetch(left, ivec2(at), 0).rgb;
    vec3 b = texelFetch(right, ivec2(at), 0).rgb;
    vec3 colour = gain > 0.0 ? gain * abs(clamp(a, 0.0, 1.0) - clamp(b, 0.0, 1.0)) : at.x < cut ? a : b;
    paint = vec4(clamp(colour, 0.0, 1.0), 1.0);
}
