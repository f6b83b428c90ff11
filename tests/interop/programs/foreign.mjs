// Reads and writes splat files with programs that are not ours: node foreign.mjs FOLDER, whose node_modules holds
// @playcanvas/splat-transform and playcanvas, and @mkkellogg/gaussian-splats-3d, three and gsplat if they are asked for.
//
// A request a line on stdin, an answer a line on stdout:
//   {do: 'read', path, out}             what splat-transform decodes: {count, columns}, `columns` has raw files of
//                                       float32 by the names that PLY gives them
//   {do: 'convert', source, path, spz}  splat-transform writes `path`, in the format of its name: {}
//   {do: 'ksplat', source, path, level, section, block, bucket}
//                                       mkkellogg's writer, of a PLY: {}
//   {do: 'spz', path}                   mkkellogg's reader of SPZ: {centers}, in the axes of the file
//   {do: 'splat', source, path}         gsplat.js's writer, of a PLY: {}
// and {error} where it fails.
import { mkdirSync, readFileSync, writeFileSync } from 'node:fs';
import { dirname, join } from 'node:path';
import { createInterface } from 'node:readline';
import { pathToFileURL } from 'node:url';

console.log = console.error; // stdout is for the answers
const manifest = (name) => join(process.argv[2], 'node_modules', name, 'package.json');

/** A package of that folder, as an ES module whatever it calls its main file. */
function load(name) {
  const { module, main } = JSON.parse(readFileSync(manifest(name), 'utf8'));
  return import(pathToFileURL(join(dirname(manifest(name)), module ?? main)).href);
}

/** The bytes of a file, in a buffer of their own, as the readers of files in pages get them. */
function bytes(path) {
  const data = readFileSync(path);
  return data.buffer.slice(data.byteOffset, data.byteOffset + data.byteLength);
}

const disk = {
  /** A source of splat-transform's, of the whole file. */
  async createSource(name) {
    const memory = new (await transform()).MemoryReadFileSystem();
    memory.set(name, new Uint8Array(bytes(name)));
    return memory.createSource(name);
  },
  async createWriter(name) {
    mkdirSync(dirname(name), { recursive: true });
    const parts = [];
    const writer = { bytesWritten: 0 };
    writer.write = async (data) => {
      parts.push(Buffer.from(data)); // a copy: the caller uses its buffer again
      writer.bytesWritten += data.byteLength;
    };
    writer.close = async () => writeFileSync(name, Buffer.concat(parts));
    return writer;
  },
  async mkdir(name) {
    mkdirSync(name, { recursive: true });
  },
};

const transform = () => load('@playcanvas/splat-transform');

async function table(path) {
  const { readFile, getInputFormat } = await transform();
  const [decoded] = await readFile({
    filename: path,
    inputFormat: getInputFormat(path),
    options: {},
    params: [],
    fileSystem: disk,
  });
  return decoded;
}

const actions = {
  async read({ path, out }) {
    const decoded = await table(path);
    const columns = {};
    for (const { name, data } of decoded.columns) {
      columns[name] = `${out}.${name}`;
      writeFileSync(columns[name], Float32Array.from(data));
    }
    return { count: decoded.numRows, columns };
  },

  async convert({ source, path, spz }) {
    const { writeFile, getOutputFormat } = await transform();
    const options = { iterations: 4, spzVersion: spz, lodSelect: [] };
    const dataTable = await table(source);
    await writeFile({ filename: path, outputFormat: getOutputFormat(path, options), dataTable, options }, disk);
    return {};
  },

  async ksplat({ source, path, level, section = 0, block, bucket }) {
    const { PlyParser, SplatBufferGenerator } = await load('@mkkellogg/gaussian-splats-3d');
    const splats = PlyParser.parseToUncompressedSplatArray(bytes(source), 2);
    const generator = SplatBufferGenerator.getStandardGenerator(1, level, section, undefined, block, bucket);
    writeFileSync(path, new Uint8Array(generator.generateFromUncompressedSplatArray(splats).bufferData));
    return {};
  },

  async spz({ path }) {
    const { SpzLoader } = await load('@mkkellogg/gaussian-splats-3d');
    const { Vector3 } = await load('three');
    globalThis.window = { setTimeout }; // which it calls, and by which others would take this for a browser
    const loading = SpzLoader.loadFromFileData(new Uint8Array(bytes(path)), 0, 0, false, 0);
    const buffer = await loading.finally(() => delete globalThis.window);
    const centers = [];
    for (let splat = 0; splat < buffer.getSplatCount(); splat++) {
      const center = new Vector3();
      buffer.getSplatCenter(splat, center);
      centers.push(center.toArray());
    }
    return { centers };
  },

  async splat({ source, path }) {
    const { PLYLoader, Scene } = await load('gsplat');
    const scene = new Scene();
    PLYLoader.LoadFromArrayBuffer(bytes(source), scene);
    writeFileSync(path, new Uint8Array(scene.getMergedSceneDataBuffer('splat')));
    return {};
  },
};

for await (const line of createInterface({ input: process.stdin })) {
  const request = JSON.parse(line);
  const reply = await actions[request.do](request).catch((error) => ({ error: String(error?.stack ?? error) }));
  process.stdout.write(JSON.stringify(reply) + '\n');
}
process.exit(0); // splat-transform's worker threads would keep it alive
