// node spark_build.mjs FILE [RUNS [BUILDER [FOLDER]]]: measures the seconds that one of Spark's own builders (its wasm, in
// Node) takes for a splat file. SPARK_DIR names a folder whose node_modules has @sparkjsdev/spark. Prints a JSON object for
// each run.
//
// BUILDER is "tiny" (base 1.5; the default) or "quality" (the Bhattacharyya builder, base 1.75). FOLDER receives the tree as
// raw files of uint32, four a node: ext0.u32 and ext1.u32, its ExtSplats, lod_tree.u32, and where there are spherical
// harmonics sh1.u32, sh2.u32, sh3a.u32 and sh3b.u32.
import fs from 'node:fs';
import path from 'node:path';
import vm from 'node:vm';

const [file, runs = '3', builder = 'tiny', folder] = process.argv.slice(2);
const lod = { tiny: true, quality: 'quality' }[builder];
if (!lod) throw new Error(`Spark has no builder ${builder}`);
const bundle = path.join(process.env.SPARK_DIR ?? '.', 'node_modules/@sparkjsdev/spark/dist/spark.module.js');
const source = fs.readFileSync(bundle, 'utf8');
const wasm = Buffer.from(source.match(/const WASM = decode64\("([^"]+)"\)/)[1], 'base64');
const worker = vm.runInThisContext(source.match(/^const jsContent = (.*?);?$/m)[1]);

// The worker answers through self.postMessage and logs the time of the build in a line of its own.
const log = [];
const handlers = [];
const answers = new Map();
globalThis.self = {
  addEventListener: (kind, handler) => handlers.push(handler),
  removeEventListener: () => {},
  postMessage: ({ id, result, error }) => {
    if (result === undefined && error === undefined) return;
    answers.get(id)?.(error === undefined ? { result } : { error });
  },
  performance,
};
const print = console.log;
console.log = (...words) => log.push(words.join(' '));
vm.runInThisContext(worker);
const send = (data) => handlers.forEach((handler) => handler({ data }));
send({ name: 'init-wasm', module: await WebAssembly.compile(wasm) });
await new Promise((resolve) => setTimeout(resolve, 300));

function keep({ numSplats, extArrays, extra }) {
  const { sh1, sh2, sh3a, sh3b } = extra;
  const arrays = { ext0: extArrays[0], ext1: extArrays[1], lod_tree: extra.lodTree, sh1, sh2, sh3a, sh3b };
  for (const [name, words] of Object.entries(arrays).filter(([, words]) => words))
    fs.writeFileSync(path.join(folder, `${name}.u32`), words.subarray(0, 4 * numSplats)); // Spark allocates more rows than it uses
}

for (let run = 1; run <= Number(runs); run++) {
  const fileBytes = new Uint8Array(fs.readFileSync(file));
  const start = performance.now();
  const { result, error } = await new Promise((resolve) => {
    answers.set(run, resolve);
    send({ id: run, name: 'loadExtSplats', args: { fileBytes, pathName: file, lod } });
  });
  if (error !== undefined) throw error;
  const seconds = (performance.now() - start) / 1000;
  const build = /(?:Tiny|Bhatt) LoD: (\d+) -> (\d+) \(([\d.]+) ms\)/.exec(log.join('\n'));
  log.length = 0;
  print(JSON.stringify({ nodes: result.lodSplats.numSplats, build: build && Number(build[3]) / 1000, all: seconds }));
  if (folder && run === Number(runs)) keep(result.lodSplats);
}
process.exit(0);
