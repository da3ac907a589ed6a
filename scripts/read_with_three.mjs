// Prints the Gaussians that the loaders of three.js r187 read from a .spz or .glb file, as JSON for the tests.
//
//     node scripts/read_with_three.mjs NODE_MODULES FILE      # npm install three@0.187.0
//
// Output: {"positions": 3 numbers per Gaussian, "covariances": 6, "colors": 4 bytes}, in the axes of the file.
import { readFileSync } from 'node:fs';
import { resolve } from 'node:path';
import { pathToFileURL } from 'node:url';

const [, , modules, file] = process.argv;
if (!file) {
  console.error('node scripts/read_with_three.mjs NODE_MODULES FILE');
  process.exit(2);
}
globalThis.self ??= globalThis;
const load = (name) => import(pathToFileURL(resolve(modules, 'three/examples/jsm/loaders', name)).href);
const bytes = Uint8Array.from(readFileSync(file)).buffer;

/** Reads a .glb and returns the geometry of its Gaussians. */
async function readGlb() {
  const [{ GLTFLoader }, { GLTFGaussianSplatLoaderExtension }] = await Promise.all(
    ['GLTFLoader.js', 'GLTFGaussianSplatLoaderExtension.js'].map(load),
  );
  const loader = new GLTFLoader();
  loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  const { scene } = await new Promise((done, failed) => loader.parse(bytes, '', done, failed));
  let geometry;
  scene.traverse((object) => { geometry ??= object.splatGeometry; });
  return geometry;
}

/** Reads a .spz and returns the geometry of its Gaussians. */
async function readSpz() {
  const { SPZLoader } = await load('SPZLoader.js');
  return new SPZLoader().parse(bytes);
}

const geometry = await (file.endsWith('.glb') ? readGlb() : readSpz());
const values = (name) => Array.from(geometry.getAttribute(name).array);
console.log(JSON.stringify({ positions: values('position'), covariances: values('covariance'), colors: values('color') }));
