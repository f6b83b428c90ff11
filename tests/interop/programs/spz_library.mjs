// Reads and writes SPZ files with the library of the format's authors: node spz_library.mjs FOLDER, whose node_modules
// holds @adobe/spz.
//
// A request a line on stdin, an answer a line on stdout; systems are names such as "RUB", or "UNSPECIFIED":
//   {do: 'read', path, to, out}                      {count, antialiased, columns}, `columns` has raw files of float32
//   {do: 'write', source, path, from, version, system}
//                                                    writes `source` again, whose numbers are taken for those of `from`,
//                                                    in the coordinate system `system`: {}. `source` has the record of
//                                                    a system: the package makes none that it would write.
// and {error} where it fails.
import { readFileSync, writeFileSync } from 'node:fs';
import { createInterface } from 'node:readline';
import { pathToFileURL } from 'node:url';
import { join } from 'node:path';

console.log = console.error; // stdout is for the answers

const entry = join(process.argv[2], 'node_modules', '@adobe', 'spz', 'dist', 'spz.js');
const spz = await (await import(pathToFileURL(entry).href)).default();

const load = (path, to) => spz.loadSpzFromBuffer(new Uint8Array(readFileSync(path)), { to: spz.CoordinateSystem[to] });

const actions = {
  read({ path, to, out }) {
    const cloud = load(path, to);
    const columns = {};
    for (const name of ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh']) {
      columns[name] = `${out}.${name}`;
      writeFileSync(columns[name], cloud[name]);
    }
    return { count: cloud.numPoints, antialiased: cloud.antialiased, columns };
  },

  write({ source, path, from, version, system }) {
    const cloud = load(source, 'UNSPECIFIED');
    cloud.extensions[0].coordinateSystem = spz.CoordinateSystem[system];
    const options = { version, from: spz.CoordinateSystem[from], sh1Bits: 8, shRestBits: 8 };
    writeFileSync(path, spz.saveSpzToBuffer(cloud, options));
    return {};
  },
};

for await (const line of createInterface({ input: process.stdin })) {
  const request = JSON.parse(line);
  let reply;
  try {
    reply = actions[request.do](request);
  } catch (error) {
    reply = { error: String(error?.stack ?? error) };
  }
  process.stdout.write(JSON.stringify(reply) + '\n');
}
