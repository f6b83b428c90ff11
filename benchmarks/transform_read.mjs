// Reads and writes splat files with splat-transform's library: node --expose-gc transform_read.mjs.
// FOREIGN_DIR names a folder whose node_modules has @playcanvas/splat-transform and playcanvas.
//
// Reads a request a line on stdin and writes an answer a line on stdout:
//   {read: path}                    {splats, seconds}: the time from the file to a table of float32 columns
//   {write: path, source, options}  {}: writes the file in the format that its name says
// The answer to a request that fails is {error}.
import fs from 'node:fs';
import path from 'node:path';
import { createInterface } from 'node:readline';
import { pathToFileURL } from 'node:url';

console.log = console.error; // stdout is for the answers
const entry = path.resolve(process.env.FOREIGN_DIR ?? '.', 'node_modules/@playcanvas/splat-transform/dist/index.mjs');
const { readFile, getInputFormat, writeFile, getOutputFormat, MemoryReadFileSystem } = await import(pathToFileURL(entry));

const disk = {
  async createSource(name) {
    const memory = new MemoryReadFileSystem();
    memory.set(name, new Uint8Array(await fs.promises.readFile(name)));
    return memory.createSource(name);
  },
  async createWriter(name) {
    const file = fs.openSync(name, 'w');
    const writer = { bytesWritten: 0 };
    writer.write = async (data) => {
      for (let done = 0; done < data.byteLength; ) done += fs.writeSync(file, data, done);
      writer.bytesWritten += data.byteLength;
    };
    writer.close = async () => fs.closeSync(file);
    return writer;
  },
  async mkdir(name) {
    fs.mkdirSync(name, { recursive: true });
  },
};

async function table(filename) {
  const request = { filename, inputFormat: getInputFormat(filename), options: {}, params: [], fileSystem: disk };
  const [decoded] = await readFile(request);
  return decoded;
}

async function answer({ read, write, source, options }) {
  if (write !== undefined) {
    const wanted = { iterations: 1, ...options };
    const dataTable = await table(source);
    await writeFile({ filename: write, outputFormat: getOutputFormat(write, wanted), dataTable, options: wanted }, disk);
    return {};
  }
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
