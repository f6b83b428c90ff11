// Reads SOG and Streamed SOG with splat-transform 3: node splat_transform.mjs FOLDER, whose node_modules holds it.
//
// A request a line on stdin, an answer a line on stdout:
//   {path, out}   {levels}: for each detail level, the finest first, {count, columns}; `columns` has raw files of float32
//                 by the names that PLY gives them
// and {error} where it fails.
import { readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';
import { createInterface } from 'node:readline';
import { pathToFileURL } from 'node:url';

console.log = console.error; // stdout is for the answers
const entry = join(process.argv[2], 'node_modules', '@playcanvas', 'splat-transform', 'dist', 'index.mjs');
const { MemoryReadFileSystem, createChunkDataPool, getInputFormat, materializeToDataTable, readFile, selectLod } = await import(pathToFileURL(entry).href);

const disk = {
  /** A source of splat-transform's, of the whole file. */
  async createSource(name) {
    const memory = new MemoryReadFileSystem();
    memory.set(name, new Uint8Array(readFileSync(name)));
    return memory.createSource(name);
  },
};

async function read({ path, out }) {
  const [source] = await readFile({ filename: path, inputFormat: getInputFormat(path), options: { lodSelect: [] }, fileSystem: disk });
  const levels = [];
  for (let level = 0; level < source.meta.numLods; level++) {
    const table = await materializeToDataTable(selectLod(source, level), createChunkDataPool());
    const columns = {};
    for (const { name, data } of table.columns) {
      columns[name] = `${out}.${level}.${name}`;
      writeFileSync(columns[name], Float32Array.from(data));
    }
    levels.push({ count: table.numRows, columns });
  }
  await source.close();
  return { levels };
}

for await (const line of createInterface({ input: process.stdin })) {
  const reply = await read(JSON.parse(line)).catch((error) => ({ error: String(error?.stack ?? error) }));
  process.stdout.write(JSON.stringify(reply) + '\n');
}
process.exit(0); // splat-transform's worker threads would keep it alive
