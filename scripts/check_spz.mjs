// Checks that the reader of a web viewer opens one of our .spz files with the values of the PLY it was made from.
//
//     npm install @sparkjsdev/spark@0.1.10 three@0.180
//     node scripts/check_spz.mjs MODEL.ply MODEL.spz          # splatsieve convert MODEL.ply MODEL.spz
//
// Prints the largest difference of each property, for values within the ranges of the format, beside half a quantization
// step of the format, and exits 1 if a difference is larger. The reader's y and z axes have the opposite direction.
import { readFileSync } from 'node:fs';

// The reader is part of a viewer, which expects a browser.
globalThis.navigator ??= { userAgent: '' };
globalThis.location ??= { href: 'file:///' };
for (const name of ['self', 'window']) globalThis[name] ??= globalThis;
globalThis.document ??= { createElement: () => ({ getContext: () => null }) };
const { SpzReader } = await import('@sparkjsdev/spark');

/** Reads a binary PLY whose properties are all float32. Returns [names, values]. */
function readPly(path) {
  const bytes = readFileSync(path);
  const end = bytes.indexOf('end_header\n') + 'end_header\n'.length;
  const lines = bytes.subarray(0, end).toString().split('\n');
  const names = lines.filter((line) => line.startsWith('property float ')).map((line) => line.split(' ')[2]);
  return [names, new Float32Array(Uint8Array.from(bytes.subarray(end)).buffer)];
}

const [, , ply, spz] = process.argv;
if (!spz) {
  console.error('node scripts/check_spz.mjs MODEL.ply MODEL.spz');
  process.exit(2);
}
const [names, values] = readPly(ply);
const valueOf = (i, name) => values[i * names.length + names.indexOf(name)];
const reader = new SpzReader({ fileBytes: new Uint8Array(readFileSync(spz)) });
await reader.parseHeader?.();
const count = values.length / names.length;
if (reader.numSplats !== count) throw new Error(`${spz} has ${reader.numSplats} Gaussians, ${ply} ${count}`);

const worst = {};
/** Records the difference between `found` and `expected` if `expected` is within the range of the format. */
function compare(property, found, expected, step, [least, most] = [-Infinity, Infinity]) {
  if (expected < least || expected > most) return;
  const entry = (worst[property] ??= { off: 0, step });
  entry.off = Math.max(entry.off, Math.abs(found - expected));
}

const C0 = 0.28209479177387814;
const axes = ['x', 'y', 'z'];
await reader.parseSplats(
  (i, ...at) => at.forEach((x, c) => {
    compare('position', c > 0 ? -x : x, valueOf(i, axes[c]), 0.5 / 2 ** reader.fractionalBits + 1e-7 * Math.abs(x));
  }),
  (i, alpha) => compare('opacity', alpha, 1 / (1 + Math.exp(-valueOf(i, 'opacity'))), 0.5 / 255),
  (i, ...rgb) => rgb.forEach((x, c) => {
    const half = 0.5 / 0.15;
    compare('color', x, 0.5 + C0 * valueOf(i, `f_dc_${c}`), (0.5 / 255 / 0.15) * C0, [0.5 - C0 * half, 0.5 + C0 * half]);
  }),
  (i, ...scale) => scale.forEach((x, c) => compare('log scale', Math.log(x), valueOf(i, `scale_${c}`), 0.5 / 16, [-10, 5.9])),
  (i, x, y, z, w) => {
    // The quaternion follows the axes and may have either sign.
    const [a, b] = [[w, x, -y, -z], [0, 1, 2, 3].map((c) => valueOf(i, `rot_${c}`))];
    const dot = (p, q) => p.reduce((sum, value, c) => sum + value * q[c], 0);
    compare('rotation', Math.abs(dot(a, b)) / Math.sqrt(dot(a, a) * dot(b, b)), 1, 1e-5);
  },
);
let wrong = 0;
for (const [property, { off, step }] of Object.entries(worst)) {
  const holds = off <= step * 1.01 + 1e-6;
  wrong += !holds;
  console.log(`${property}: ${off.toExponential(2)} off at most, ${step.toExponential(2)} of the format${holds ? '' : ': WRONG'}`);
}
process.exit(wrong ? 1 : 0);
