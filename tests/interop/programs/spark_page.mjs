// Draws splat files with the real Spark in headless Chromium: node spark_page.mjs FOLDER CHROMIUM; FOLDER's node_modules
// holds @sparkjsdev/spark, three and playwright-core, CHROMIUM is the browser's program.
//
// A request a line on stdin, an answer a line on stdout:
//   {do: 'open', path, width, height, near, far, layout, paged}
//                       a new page with that file in it, which Spark keeps in a layout, "Packed" or "Ext"; `paged` has it
//                       fetch a RAD file chunk by chunk, as cuts need them: {numSplats, lod}, how many splats the file
//                       has, and nodes if it is a LoD tree
//   {do: 'draw', viewToWorld, fovy, budget, radial, out}
//                       draws that file as a camera sees it, sixteen numbers column by column and degrees; from a tree
//                       `budget` nodes at most, all directions alike. {drawn, files}: how many splats, and the paths of
//                       raw files: `rounded`, RGBA, a byte each, the lower row first; `exact`, the same in float32, for
//                       which nothing was rounded while blending; `indices`, uint32, the nodes of the tree, if it is one
//   {do: 'requests'}    {requests}: what the page asked for of the file and of those beside it since it was opened, in
//                       order: {name, range, bytes}, range a list of first and last byte or null for a whole file
// and {error} where it fails.
//
// Spark draws whatever it has sorted last, and finds cuts in the background. So that a picture does not show the order
// or the cut of the view before, it does not update by itself here (`autoUpdate` is false) but is asked to, until the
// camera that it has the cut and the order of is ours; and of a paged file, until all chunks that the cut wants are there.
import { createReadStream, existsSync, statSync, writeFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { createRequire } from 'node:module';
import { basename, dirname, join, resolve } from 'node:path';
import { createInterface } from 'node:readline';

console.log = console.error; // stdout is for the answers
const [folder, chromium] = process.argv.slice(2);
const packages = resolve(folder, 'node_modules');
const playwright = createRequire(join(packages, 'x.js'))('playwright-core');

/** What runs in the page. */
function inPage(THREE, Spark) {
  let renderer, scene, spark, mesh, cut, target, speck, near, far;

  window.open_ = async (options) => {
    ({ near, far } = options);
    renderer = new THREE.WebGLRenderer({ antialias: false, alpha: true });
    renderer.setPixelRatio(1);
    renderer.setSize(options.width, options.height, false);
    renderer.setClearColor(0x000000, 1);
    renderer.getContext().getExtension('EXT_float_blend');
    target = new THREE.WebGLRenderTarget(options.width, options.height, { type: THREE.FloatType });
    speck = new THREE.WebGLRenderTarget(1, 1);
    scene = new THREE.Scene();
    const evenly = { coneFov0: 0, coneFov: 0, coneFoveate: 1, behindFoveate: 1 };
    const extSplats = options.layout === 'Ext';
    const pages = { pagedExtSplats: extSplats, maxPagedSplats: options.pages * 65536 };
    const quiet = { autoUpdate: false, lodRaycast: 0, ...evenly };
    spark = new Spark.SparkRenderer({ renderer, accumExtSplats: true, ...pages, ...quiet });
    scene.add(spark);
    const take = spark.updateLodIndices.bind(spark); // what it keeps of a second cut is on the GPU only
    spark.updateLodIndices = (meshes, cuts) => {
      [cut] = Object.values(cuts);
      take(meshes, cuts);
    };
    mesh = new Spark.SplatMesh({ url: options.url, ...(options.paged ? { paged: true } : { extSplats }) });
    await mesh.initialized;
    scene.add(mesh);
    if (mesh.paged) return { numSplats: (await mesh.paged.getRadMeta()).meta.count, lod: null };
    const { numSplats, lodSplats } = mesh.splats;
    return { numSplats, lod: lodSplats?.numSplats ?? null };
  };

  /** Whether a paged file has all chunks that the cut wants, and none is on its way. */
  const isResident = ({ fetchPriority, fetchers, fetched, lodTreeUpdates, newUploads, readyUploads, ...pager }) =>
    [fetchers, fetched, lodTreeUpdates, newUploads, readyUploads, spark.lodUpdates].every((list) => !list.length) &&
    fetchPriority.length > 0 &&
    fetchPriority.every(({ splats, chunk }) => pager.splatsChunkToPage.get(splats)?.[chunk]);

  /** Whether the cut that is there is of this camera. */
  const isCutFor = (camera) => {
    if (!mesh.paged && !mesh.splats.lodSplats) return true;
    if (mesh.paged && !(spark.pager && isResident(spark.pager))) return false;
    const found = spark.currentLod;
    return Boolean(found) && found === spark.lastLod && !spark.lodDirty && found.pos.distanceTo(camera.position) < 1e-6;
  };

  /** The nodes of a cut: of a paged file Spark has where they are in its pages, 65,536 nodes each. */
  const nodesOf = ({ indices, numSplats }) => {
    const nodes = indices.slice(0, numSplats);
    const pages = mesh.paged ? spark.pager.pageToSplatsChunk : null;
    return pages ? nodes.map((index) => (pages[index >>> 16].chunk << 16) | (index & 0xffff)) : nodes;
  };

  const pause = () => new Promise((done) => setTimeout(done, 5));

  /** Updates until what is shown is what this camera sees. */
  async function settle(camera) {
    spark.lodDirty = true;
    for (;;) {
      const ready = isCutFor(camera); // before this update, so that it is what the update shows
      renderer.getDrawingBufferSize(spark.renderSize); // how large a pixel is; drawing sets it
      await spark.update({ scene, camera });
      while (spark.sorting || spark.sortDirty) await pause();
      if (ready) return;
      render(camera, speck); // an order that was not drawn with is not replaced by the next one
      await pause();
    }
  }

  function render(camera, where) {
    renderer.setRenderTarget(where);
    renderer.render(scene, camera);
  }

  const base64 = async (array) => {
    const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
    const reader = new FileReader();
    const read = new Promise((done) => (reader.onload = done));
    reader.readAsDataURL(new Blob([bytes]));
    await read;
    return reader.result.slice(reader.result.indexOf(',') + 1);
  };

  window.draw_ = async ({ viewToWorld, fovy, budget, radial }) => {
    const gl = renderer.getContext();
    const { width, height } = renderer.domElement;
    const camera = new THREE.PerspectiveCamera(fovy, width / height, near, far);
    camera.matrix.fromArray(viewToWorld).decompose(camera.position, camera.quaternion, camera.scale);
    camera.updateMatrixWorld(true);
    spark.sortRadial = radial;
    if (budget) spark.lodSplatCount = budget;
    await settle(camera);
    const read = (type, pixels) => gl.readPixels(0, 0, width, height, gl.RGBA, type, pixels) ?? pixels;
    render(camera, null);
    const rounded = read(gl.UNSIGNED_BYTE, new Uint8Array(4 * width * height));
    // Into a target that is not the screen, Spark writes linear colours.
    Object.defineProperty(spark.uniforms.encodeLinear, 'value', { get: () => false, set: () => {} });
    render(camera, target);
    const exact = read(gl.FLOAT, new Float32Array(4 * width * height));
    renderer.setRenderTarget(null);
    const failed = gl.getError();
    if (failed) throw new Error(`WebGL error ${failed}`);
    return {
      drawn: spark.activeSplats,
      rounded: await base64(rounded),
      exact: await base64(exact),
      indices: cut ? await base64(nodesOf(cut)) : null,
    };
  };
}

const imports = {
  three: '/three/build/three.module.js',
  'three/addons/': '/three/examples/jsm/',
  '@sparkjsdev/spark': '/@sparkjsdev/spark/dist/spark.module.js',
};
const page = `<!doctype html><script type="importmap">${JSON.stringify({ imports })}</script><script type="module">
import * as THREE from 'three'; import * as Spark from '@sparkjsdev/spark'; (${inPage})(THREE, Spark); window.ready = true;
</script>`;

let scenePath = '';
let requests = [];

/** Sends a file, or the bytes of it that the request's Range names. */
function send(file, request, response) {
  const size = statSync(file).size;
  const range = /^bytes=(\d+)-(\d+)$/.exec(request.headers.range ?? '')?.slice(1).map(Number) ?? null;
  const [start, end] = range ? [range[0], Math.min(range[1], size - 1)] : [0, size - 1];
  response.setHeader('content-type', file.endsWith('.js') ? 'text/javascript' : 'application/octet-stream');
  response.setHeader('content-length', end - start + 1);
  if (range) response.writeHead(206, { 'content-range': `bytes ${start}-${end}/${size}` });
  createReadStream(file, { start, end }).pipe(response);
  return { range, bytes: end - start + 1 };
}

const server = createServer((request, response) => {
  const { pathname } = new URL(request.url, 'http://localhost');
  const name = pathname.startsWith('/scene/') ? basename(pathname) : null;
  const file = name ? join(dirname(scenePath), name) : join(packages, pathname);
  if (pathname === '/') response.setHeader('content-type', 'text/html').end(page);
  else if (!existsSync(file)) response.writeHead(404).end();
  else {
    const sent = send(file, request, response);
    if (name) requests.push({ name, ...sent });
  }
});
await new Promise((done) => server.listen(0, '127.0.0.1', done));

const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist'];
const browser = await playwright.chromium.launch({ executablePath: chromium, args });
let tab;

async function open({ path, ...options }) {
  await tab?.close();
  scenePath = path;
  requests = [];
  tab = await browser.newPage();
  tab.on('console', (message) => console.error(message.text()));
  tab.on('pageerror', (error) => console.error(error));
  await tab.goto(`http://127.0.0.1:${server.address().port}`);
  await tab.waitForFunction('window.ready');
  return tab.evaluate((given) => window.open_(given), { ...options, url: `/scene/${basename(path)}` });
}

async function draw({ out, ...options }) {
  const { drawn, ...found } = await tab.evaluate((given) => window.draw_(given), options);
  const files = {};
  for (const [name, data] of Object.entries(found)) {
    if (data === null) continue;
    files[name] = `${out}.${name}`;
    writeFileSync(files[name], Buffer.from(data, 'base64'));
  }
  return { drawn, files };
}

for await (const line of createInterface({ input: process.stdin })) {
  const { do: name, ...request } = JSON.parse(line);
  const answer = await { open, draw, requests: async () => ({ requests }) }[name](request).catch((error) => ({ error: String(error?.message ?? error) }));
  process.stdout.write(JSON.stringify(answer) + '\n');
}
await browser.close();
server.close();
