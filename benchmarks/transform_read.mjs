// Reads splat files with splat-transform's library: node --expose-gc transform_read.mjs.
// FOREIGN_DIR names a folder whose node_modules has @playcanvas/splat-transform and playcanvas.
//
// Reads a request a line on stdin and writes an answer a line on stdout:
//   {read: path}  {splats, seconds}: the time from the file to a table of float32 columns
// The answer to a request that fails is {error}.
import fs from 'node:fs';
import path from 'node:path';
import { createInterface } from 'node:readline';
import { pathToFileURL } from 'node:url';

console.log = console.error; // stdout is for the answers
const entry = path.resolve(process.env.FOREIGN_DIR ?? '.', 'node_modules/@playcanvas/splat-transform/dist/index.mjs');
const library = await import(pathToFileURL(entry));
const { readFile, getInputFormat, MemoryReadFileSystem } = library;

const disk = {
  async createSource(name) {
    const memory = new MemoryReadFileSystem();
    memory.set(name, new Uint8Array(await fs.promises.readFile(name)));
    return memory.createSource(name);
  },
};

async function table(filename) {
  const request = { filename, inputFormat: getInputFormat(filename), options: {}, params: [], fileSystem: disk };
  const [decoded] = await readFile(request);
  // Since version 3 this is a source, which has read a header only, or, of SOG, images, whose values it works out later.
  if (!library.materializeToDataTable) return decoded;
  return library.materializeToDataTable(decoded, library.createChunkDataPool());
}

async function answer({ read }) {
  globalThis.gc(); // so that this run does not collect the garbage of earlier ones
  const start = performance.now();
  const { numRows } = await table(read);
  return { splats: numRows, seconds: (performance.now() - start) / 1000 };
}

for await (const line of createInterface({ input: process.stdin })) {
  const reply = await answer(JSON.parse(line)).catch((error) => ({ error: String(error?.message ?? error) }));
  process.stdout.write(JSON.stringify(reply) + '\n');
}
process.exit(0); // the library's worker threads would keep the process alive
