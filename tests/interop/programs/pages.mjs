// Shows scenes in the engines that read SOG, in headless Chromium: node pages.mjs FOLDER CHROMIUM; FOLDER's node_modules
// holds the engines and playwright-core, CHROMIUM is the browser's program.
//
// A request a line on stdin, an answer a line on stdout:
//   {do: 'open', html, driver, folder, width, height}
//                       a new page, which is `html` with this folder's script `driver`, if any, behind it; what it loads comes
//                       from `folder` or from node_modules: {}
//   {do: 'draw', camera, out}
//                       waits until the page has loaded everything, and draws what `camera` sees, which the driver
//                       understands, to the file `out`: RGBA, a byte each, the lower row first. {frames, ...}, what the
//                       driver says of the frames until then
//   {do: 'still', out}  writes a PNG of a page without a driver, once it shows something and that stays as it is: {}
//   {do: 'requests'}    {requests}: the files of `folder` that the page asked for since it was opened, in order:
//                       {name, bytes, milliseconds}, since the first one
// and {error} where it fails.
import { createReadStream, statSync, writeFileSync } from 'node:fs';
import { createServer } from 'node:http';
import { createRequire } from 'node:module';
import { dirname, extname, join, resolve, sep } from 'node:path';
import { createInterface } from 'node:readline';
import { fileURLToPath } from 'node:url';

console.log = console.error; // stdout is for the answers
const [packages, chromium] = process.argv.slice(2);
const here = dirname(fileURLToPath(import.meta.url));
const playwright = createRequire(join(resolve(packages), 'node_modules', 'x.js'))('playwright-core');
const TYPES = { '.html': 'text/html', '.css': 'text/css', '.js': 'text/javascript', '.mjs': 'text/javascript', '.json': 'application/json', '.webp': 'image/webp' };

let html = '';
let folder = here;
let requests = [];
let failures = [];

/** Where a path of the server lies on disk, or null if it leaves the folder that it belongs to. */
function located(path) {
  const [base, rest] = path.startsWith('/node_modules/') ? [packages, path] : path.startsWith('/drivers/') ? [here, path.slice(8)] : [folder, path];
  const file = resolve(base, rest.slice(1));
  return file.startsWith(resolve(base) + sep) ? file : null;
}

const server = createServer((request, response) => {
  const path = decodeURIComponent(new URL(request.url, 'http://localhost').pathname);
  if (path === '/') return response.setHeader('content-type', 'text/html').end(html);
  const file = located(path);
  const size = file && statSync(file, { throwIfNoEntry: false })?.size;
  if (size === undefined || size === null) return response.writeHead(404).end();
  if (!path.startsWith('/node_modules/') && !path.startsWith('/drivers/'))
    requests.push({ name: path.slice(1), bytes: size, at: performance.now() });
  response.setHeader('content-type', TYPES[extname(file)] ?? 'application/octet-stream');
  const range = /^bytes=(\d+)-(\d*)$/.exec(request.headers.range ?? '');
  const [start, end] = range ? [Number(range[1]), Math.min(Number(range[2] || size), size - 1)] : [0, size - 1];
  if (range) response.writeHead(206, { 'content-range': `bytes ${start}-${end}/${size}` });
  else response.setHeader('content-length', size);
  createReadStream(file, { start, end }).pipe(response);
});
await new Promise((done) => server.listen(0, '127.0.0.1', done));

/** Whether all pixels of a PNG in base64 are the same; runs in the page. */
async function hasOneColor(png) {
  const bitmap = await createImageBitmap(await (await fetch(`data:image/png;base64,${png}`)).blob());
  const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext('2d');
  context.drawImage(bitmap, 0, 0);
  const pixels = new Uint32Array(context.getImageData(0, 0, bitmap.width, bitmap.height).data.buffer);
  return pixels.every((each) => each === pixels[0]);
}

const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist'];
const browser = await playwright.chromium.launch({ executablePath: chromium, args });
let tab;

const actions = {
  async open({ html: page, driver, folder: from, width, height }) {
    await tab?.close();
    html = driver ? `${page}<script type="module" src="/drivers/${driver}"></script>` : page;
    [folder, requests, failures] = [from, [], []];
    tab = await browser.newPage({ viewport: { width, height } });
    tab.on('console', (message) => console.error(message.text()));
    tab.on('pageerror', (error) => failures.push(String(error?.stack ?? error)));
    await tab.goto(`http://127.0.0.1:${server.address().port}`);
    if (driver) await tab.waitForFunction('window.draw');
    return {};
  },
  async draw({ camera, out }) {
    const { pixels, ...found } = await tab.evaluate((given) => window.draw(given), camera);
    writeFileSync(out, Buffer.from(pixels, 'base64'));
    return found;
  },
  async still({ out }) {
    for (let before = null; ; ) {
      const now = await tab.screenshot({ path: out });
      if (failures.length) throw new Error('the page failed');
      if (before?.equals(now) && !(await tab.evaluate(hasOneColor, now.toString('base64')))) return {};
      before = now;
      await tab.waitForTimeout(1000);
    }
  },
  async requests() {
    return { requests: requests.map(({ name, bytes, at }) => ({ name, bytes, milliseconds: at - requests[0].at })) };
  },
};

for await (const line of createInterface({ input: process.stdin })) {
  const { do: name, ...request } = JSON.parse(line);
  const answer = await actions[name](request).catch((error) => ({ error: String(error?.message ?? error) + failures.join('\n') }));
  process.stdout.write(JSON.stringify(answer) + '\n');
}
await browser.close();
server.close();
