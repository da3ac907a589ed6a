#version 300 es
// Computes alpha of one Gaussian at one pixel, as crates/splat-render/src/blend.rs does; blended back to front.
precision highp float;

uniform vec2 size;
flat in vec4 shape;  // u v narrow slope
flat in vec2 fade;   // fall opacity
flat in vec3 ink;
out vec4 paint;

void main() {
    vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - 0.5;
    float dy = pixel.y - shape.y;
    float across = pixel.x - shape.x - shape.w * dy;
    float alpha = min(0.99, fade.y * exp2(-shape.z * across * across - fade.x * dy * dy));
    if (alpha < 1.0 / 255.0) discard;
    paint = vec4(alpha * ink, alpha);
}
