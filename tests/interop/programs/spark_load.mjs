// Loads splat files with the real Spark: node spark_load.mjs FOLDER, whose node_modules holds @sparkjsdev/spark.
//
// A request a line on stdin, {method, path, name, options, words, out}: calls the worker's `method` (loadExtSplats or
// loadPackedSplats) with the bytes at `path`, as if they had come from `name`. `words` has paths of raw files of uint32
// by the option that they are for, or a list of paths where the option is a list of arrays. An answer a line on stdout:
// {numSplats, lod, encoding, arrays}, or {error}. Each array is a raw file of uint32, `arrays` has its path by name;
// those of a list are named "name.0" and so on.
//
// {method: "initLodTree", path} keeps the tree of that raw file of four uint32 a node; the answer is {lodId}. With it,
// {method: "traverseLodTrees", options, out} finds a cut; `options` are the worker's, but for `instances`, a list. The
// answer is {counts, chunks, pixelLimit, arrays}: nodes of each instance, [lodId, chunk] of what was looked into, and
// the nodes' indices, one instance after the other.
//
// A paged tree: {method: "newLodTree", options: {capacity}} makes a page pool and {method: "newSharedLodTree", options:
// {lodId}} a tree in it; both answer {lodId}. {method: "updateLodTrees", path, options: {ranges}} puts chunks into pages,
// or removes them: `ranges` are the worker's, with `start` in place of `lodTreeData`, the first node in the raw file.
//
// In a page Spark starts a Web Worker from the source that its module holds as a string, and posts it the wasm that
// the module holds in base64. Here an EventTarget stands in for the worker's global scope.
import { readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { createInterface } from 'node:readline';
import { runInThisContext } from 'node:vm';

console.log = console.error; // Spark says how it is getting on; stdout is for the answers
const lines = readFileSync(join(process.argv[2], 'node_modules/@sparkjsdev/spark/dist/spark.module.js'), 'utf8').split('\n');

function literal(start, end) {
  const line = lines.find((candidate) => candidate.startsWith(start));
  if (!line) throw new Error(`this version of Spark has no line that starts with ${start}`);
  return runInThisContext(line.slice(start.length, line.lastIndexOf(end)));
}

const scope = new EventTarget();
const post = (data) => scope.dispatchEvent(new MessageEvent('message', { data }));
const waiting = new Map();
scope.postMessage = ({ id, status, error, result }) => {
  if (status !== undefined) return;
  const { resolve, reject } = waiting.get(id);
  waiting.delete(id);
  if (error === undefined) resolve(result);
  else reject(error);
};
new Function('self', literal('const jsContent = ', ';'))(scope);
post({ name: 'init-wasm', module: await WebAssembly.compile(Buffer.from(literal('const WASM = decode64(', ')'), 'base64')) });

let calls = 0;
function call(name, args) {
  const id = ++calls;
  return new Promise((resolve, reject) => {
    waiting.set(id, { resolve, reject });
    post({ id, name, args });
  });
}

const uint32s = (path) => new Uint32Array(new Uint8Array(readFileSync(path)).buffer);

async function initLodTree(path) {
  const lodTree = uint32s(path);
  const { lodId } = await call('initLodTree', { numSplats: lodTree.length / 4, lodTree });
  return { lodId };
}

async function updateLodTrees(path, ranges) {
  const words = path && uint32s(path);
  const withData = ({ start, ...range }) => ({
    ...range,
    lodTreeData: start === undefined ? undefined : words.slice(4 * start, 4 * (start + range.count)),
  });
  await call('updateLodTrees', { ranges: ranges.map(withData) });
  return {};
}

async function traverseLodTrees(options, out) {
  const keys = options.instances.map((_, at) => `instance ${at}`);
  const instances = Object.fromEntries(keys.map((key, at) => [key, { instanceId: key, ...options.instances[at] }]));
  const { keyIndices, chunks, pixelLimit } = await call('traverseLodTrees', { ...options, instances });
  const cuts = keys.map((key) => keyIndices[key]);
  const indices = Uint32Array.from(cuts.flatMap(({ indices, numSplats }) => Array.from(indices.subarray(0, numSplats))));
  writeFileSync(out, indices);
  return { counts: cuts.map(({ numSplats }) => numSplats), chunks, pixelLimit, arrays: { indices: out } };
}

async function answer({ method, path, name, options, words, out }) {
  if (method === 'initLodTree') return initLodTree(path);
  if (method === 'newLodTree' || method === 'newSharedLodTree') return call(method, options);
  if (method === 'updateLodTrees') return updateLodTrees(path, options.ranges);
  if (method === 'traverseLodTrees') return traverseLodTrees(options, out);
  const given = Object.entries(words ?? {}).map(([key, file]) => [key, Array.isArray(file) ? file.map(uint32s) : uint32s(file)]);
  const fileBytes = new Uint8Array(readFileSync(path));
  const result = await call(method, { ...options, ...Object.fromEntries(given), fileBytes, pathName: name });
  const splats = result.lodSplats ?? result;
  const lists = Object.entries(splats.extra).filter(([, value]) => Array.isArray(value));
  const parts = lists.flatMap(([key, list]) => list.map((value, at) => [`${key}.${at}`, value]));
  const [ext0, ext1] = splats.extArrays ?? [];
  const found = { ext0, ext1, packed: splats.packedArray, ...splats.extra, ...Object.fromEntries(parts) };
  const arrays = {};
  for (const [key, values] of Object.entries(found)) {
    if (!(values instanceof Uint32Array)) continue;
    arrays[key] = `${out}.${key}`;
    writeFileSync(arrays[key], new Uint8Array(values.buffer, values.byteOffset, values.byteLength));
  }
  return { numSplats: splats.numSplats, lod: result.lodSplats !== undefined, encoding: splats.splatEncoding, arrays };
}

for await (const line of createInterface({ input: process.stdin })) {
  const reply = await answer(JSON.parse(line)).catch((error) => ({ error: String(error?.message ?? error) }));
  process.stdout.write(JSON.stringify(reply) + '\n');
}
