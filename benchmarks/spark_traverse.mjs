// node spark_traverse.mjs: runs Spark's own traversal (its wasm, in Node). SPARK_DIR names a folder whose node_modules has
// @sparkjsdev/spark.
//
// Reads a request a line on stdin: {tree: FILE of four uint32 a node} loads a tree in place of the last one;
// {views: [{viewToObjectCols, maxSplats, pixelScaleLimit}, ...], indices: FILE or null} traverses it. Writes an answer a line
// on stdout: {ms: [milliseconds of each view]}; the nodes of the last view go to FILE.
import fs from 'node:fs';
import path from 'node:path';
import readline from 'node:readline';
import vm from 'node:vm';

const bundle = path.join(process.env.SPARK_DIR ?? '.', 'node_modules/@sparkjsdev/spark/dist/spark.module.js');
const source = fs.readFileSync(bundle, 'utf8');
const wasm = Buffer.from(source.match(/const WASM = decode64\("([^"]+)"\)/)[1], 'base64');

const handlers = [];
const answers = new Map();
globalThis.self = {
  addEventListener: (kind, handler) => handlers.push(handler),
  removeEventListener: () => {},
  postMessage: ({ id, result, error }) => answers.get(id)?.(error === undefined ? { result } : { error }),
  performance,
};
console.log = console.error;
vm.runInThisContext(vm.runInThisContext(source.match(/^const jsContent = (.*?);?$/m)[1]));
const send = (data) => handlers.forEach((handler) => handler({ data }));
send({ name: 'init-wasm', module: await WebAssembly.compile(wasm) });
await new Promise((resolve) => setTimeout(resolve, 300));

let calls = 0;
async function call(name, args) {
  const id = ++calls;
  const { result, error } = await new Promise((resolve) => {
    answers.set(id, resolve);
    send({ id, name, args });
  });
  answers.delete(id);
  if (error !== undefined) throw error;
  return result;
}

let lodId;
const whole = { lodScale: 1, behindFoveate: 1, coneFov0: 0, coneFov: 0, coneFoveate: 1 };
for await (const line of readline.createInterface({ input: process.stdin })) {
  const { tree, views, indices } = JSON.parse(line);
  const ms = [];
  if (tree) {
    if (lodId !== undefined) await call('disposeLodTree', { lodId });
    const bytes = fs.readFileSync(tree);
    const lodTree = new Uint32Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 4);
    ({ lodId } = await call('initLodTree', { numSplats: lodTree.length / 4, lodTree }));
  }
  for (const { viewToObjectCols, maxSplats, pixelScaleLimit } of views ?? []) {
    const instances = { a: { instanceId: 'a', lodId, viewToObjectCols, ...whole } };
    const start = performance.now();
    const result = await call('traverseLodTrees', { maxSplats, pixelScaleLimit, traverseMode: 'standard', instances });
    ms.push(performance.now() - start);
    const { numSplats, indices: nodes } = result.keyIndices.a;
    if (indices) fs.writeFileSync(indices, new Uint8Array(nodes.buffer, nodes.byteOffset, 4 * numSplats));
  }
  process.stdout.write(`${JSON.stringify({ ms })}\n`);
}
