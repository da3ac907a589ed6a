// Reads a .spz file with the library of its authors (@adobe/spz), and writes its Gaussians as a PLY and as a new .spz.
//
//     node scripts/read_with_spz.mjs NODE_MODULES IN.spz OUT.ply OUT.spz      # npm install @adobe/spz@0.2.3
//
// The PLY has the axes of 3DGS (x right, y down, z forward), which the library converts from those of the format.
import { readFileSync, writeFileSync } from 'node:fs';
import { resolve } from 'node:path';
import { pathToFileURL } from 'node:url';

const [, , modules, input, ply, output] = process.argv;
if (!output) {
  console.error('node scripts/read_with_spz.mjs NODE_MODULES IN.spz OUT.ply OUT.spz');
  process.exit(2);
}
const module = await import(pathToFileURL(resolve(modules, '@adobe/spz/dist/spz.js')).href);
const spz = await module.default();
const axes = spz.CoordinateSystem.RDF;
const cloud = spz.loadSpzFromBuffer(new Uint8Array(readFileSync(input)), { to: axes });

const coefficients = cloud.sh.length / cloud.numPoints / 3;
const names = ['x', 'y', 'z', 'f_dc_0', 'f_dc_1', 'f_dc_2'];
for (let k = 0; k < 3 * coefficients; k++) names.push(`f_rest_${k}`);
names.push('opacity', 'scale_0', 'scale_1', 'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3');
const rows = new Float32Array(names.length * cloud.numPoints);
for (let i = 0; i < cloud.numPoints; i++) {
  const three = (values) => Array.from(values.subarray(3 * i, 3 * i + 3));
  const [x, y, z, w] = cloud.rotations.subarray(4 * i, 4 * i + 4);
  // The library has the three channels of a coefficient together; a PLY has all coefficients of a channel together.
  const rest = [0, 1, 2].flatMap((channel) =>
    Array.from({ length: coefficients }, (_, k) => cloud.sh[3 * (coefficients * i + k) + channel]));
  const row = [...three(cloud.positions), ...three(cloud.colors), ...rest, cloud.alphas[i], ...three(cloud.scales), w, x, y, z];
  rows.set(row, names.length * i);
}
const header = ['ply', 'format binary_little_endian 1.0', `element vertex ${cloud.numPoints}`,
  ...names.map((name) => `property float ${name}`), 'end_header', ''].join('\n');
writeFileSync(ply, Buffer.concat([Buffer.from(header), Buffer.from(rows.buffer)]));
const options = { version: spz.LATEST_SPZ_HEADER_VERSION, from: axes, sh1Bits: 5, shRestBits: 4 };
writeFileSync(output, spz.saveSpzToBuffer(cloud, options));
