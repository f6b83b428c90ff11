// Drives the page of sparklod view in headless Chromium: node view_page.mjs FOLDER CHROMIUM; FOLDER's node_modules holds
// playwright-core, CHROMIUM is the browser's program.
//
// A request a line on stdin, an answer a line on stdout, {error} where it fails:
//   {do: 'open', url, width, height, without, hold}
//                             a new tab with that page, which gets nothing from the hosts of `without`, and no splats
//                             before 'release' with `hold`
//   {do: 'release'}
//   {do: 'settle'}            waits until the cut and the order of the splats are those of the camera, and have been drawn
//   {do: 'state'}             what the panel says and what Spark has
//   {do: 'message'}           waits for the page to say something, and answers {text}
//   {do: 'picture', out}      writes a PNG of the page without its panel
//   {do: 'screenshot', out}   writes a PNG of the page as it is
//   {do: 'click', id}         clicks, or touches, an element
//   {do: 'targets'}           {targets}: the width and height of everything that can be clicked, by id or name
//   {do: 'middle'}            {middle}: where the target of the camera is, in pixels of the page
//   {do: 'press', key}        presses a key
//   {do: 'fill', id, value}   fills a field, or moves a slider
//   {do: 'drag', dx, dy}      drags the scene by pixels
//   {do: 'drop', name, text}  drops a file onto the page
//   {do: 'fail', how, text}   has a script of the page fail: 'rejection', 'console' or 'event'
import { createRequire } from 'node:module';
import { join, resolve } from 'node:path';
import { createInterface } from 'node:readline';

console.log = console.error; // stdout is for the answers
const [folder, chromium] = process.argv.slice(2);
const playwright = createRequire(join(resolve(folder, 'node_modules'), 'x.js'))('playwright-core');
const args = ['--no-sandbox', '--use-angle=swiftshader', '--enable-unsafe-swiftshader', '--ignore-gpu-blocklist'];
const browser = await playwright.chromium.launch({ executablePath: chromium, args });
let tab;
let faults = [];

let release = async () => ({});

async function open({ url, width, height, without = [], hold = false }) {
  await tab?.close();
  faults = [];
  tab = await browser.newPage({ viewport: { width, height } });
  for (const host of without) await tab.route(`**://${host}/**`, (route) => route.abort());
  if (hold) {
    const released = new Promise((done) => (release = async () => (done(), {})));
    await tab.route('**/data/**', (route) => released.then(() => route.continue()));
  }
  tab.on('console', (message) => {
    console.error(message.text());
    if (message.type() === 'error') faults.push(message.text());
  });
  tab.on('pageerror', (error) => faults.push(String(error)));
  await tab.goto(url);
  return {};
}

/** What the page is doing; runs in the page. */
function progress() {
  const view = window.sparklod;
  if (!view) return null;
  const { spark, app, scene, drawn } = view.stage;
  if (!spark) return { busy: view.files.some((shown) => shown.loading), frame: app?.frame ?? scene.frameState.frameNumber, drawn };
  const { camera } = view;
  const { pager } = spark;
  const isPaged = view.files.some((shown) => shown.paged);
  const isTree = view.files.some((shown) => shown.isTree);
  const cut = spark.currentLod;
  const isCut = !isTree || (cut && cut === spark.lastLod && !spark.lodDirty && cut.pos.distanceTo(camera.position) < 1e-6);
  const isLoaded = !isPaged || (pager && !pager.fetchers.length && !pager.fetched.length && !pager.newUploads.length);
  const busy = spark.sorting || spark.sortDirty || !spark.activeSplats || !isCut || !isLoaded;
  return { busy: Boolean(busy), frame: view.stage.renderer.info.render.frame, drawn: spark.activeSplats };
}

async function settle() {
  let from = null;
  for (;;) {
    const now = await tab.evaluate(progress);
    if (!now || now.busy || now.drawn !== from?.drawn) from = now && !now.busy ? now : null;
    else if (now.frame >= from.frame + 10) return {};
    await tab.waitForTimeout(30);
  }
}

const state = async () => {
  while (!(await tab.evaluate(() => Boolean(window.sparklod)))) await tab.waitForTimeout(30);
  return tab.evaluate((found) => {
    const text = (id) => document.getElementById(id).textContent;
    const { stage, files, player } = window.sparklod;
    return {
      loading: document.getElementById('loading').hidden ? null : text('loading'),
      drawn: stage.drawn,
      said: text('drawn'),
      budget: text('budget-text'),
      camera: document.getElementById('camera').value,
      chunks: document.getElementById('chunks-row').hidden ? null : text('chunks'),
      files: [...document.querySelectorAll('#files small')].map((each) => each.textContent),
      legend: document.getElementById('legend').hidden ? null : text('legend-marks'),
      path: document.getElementById('path').hidden ? null : text('path-name'),
      errors: [...document.querySelectorAll('#faults li')].map((each) => each.textContent),
      message: document.getElementById('message').hidden ? null : text('message-text'),
      playing: player.playing,
      time: player.time,
      paged: files.map((shown) => Boolean(shown.paged)),
      meshes: stage.group?.children.length,
      faults: found,
    };
  }, faults);
};

async function message() {
  const said = tab.locator('#message-text');
  for (;;) {
    const text = await said.textContent();
    if (text && !text.startsWith('Starting') && (await said.isVisible())) return { text };
    await tab.waitForTimeout(30);
  }
}

async function picture({ out }) {
  await tab.keyboard.press('h');
  await settle(); // the picture moves to the middle of the page
  const button = (value) => tab.evaluate((each) => (document.getElementById('panel-show').style.visibility = each), value);
  await button('hidden');
  await tab.screenshot({ path: out });
  await button('');
  await tab.keyboard.press('h');
  return {};
}

const screenshot = async ({ out }) => (await tab.screenshot({ path: out }), {});
const click = async ({ id }) => (await tab.locator(`#${id}`).click(), {});

const targets = () =>
  tab.evaluate(() => {
    const all = [...document.querySelectorAll('button, select, input')];
    const boxes = all.filter((each) => each.checkVisibility()).map((each) => [each.closest('label') ?? each, each]);
    const named = boxes.map(([target, each]) => [each.id || target.textContent, target.getBoundingClientRect()]);
    return { targets: Object.fromEntries(named.map(([name, { width, height }]) => [name, [width, height]])) };
  });

const middle = () =>
  tab.evaluate(() => {
    const { controls, camera } = window.sparklod;
    const { x, y } = controls.target.project(camera);
    return { middle: [((1 + x) / 2) * window.innerWidth, ((1 - y) / 2) * window.innerHeight] };
  });

const press = async ({ key }) => (await tab.keyboard.press(key), {});
const fill = async ({ id, value }) => (await tab.locator(`#${id}`).fill(value), {});

async function drag({ dx, dy }) {
  await tab.mouse.move(40, 40);
  await tab.mouse.down();
  await tab.mouse.move(40 + dx, 40 + dy, { steps: 3 });
  await tab.mouse.up();
  return {};
}

async function drop({ name, text }) {
  const dataTransfer = await tab.evaluateHandle(
    ([fileName, content]) => {
      const held = new DataTransfer();
      held.items.add(new File([content], fileName));
      return held;
    },
    [name, text],
  );
  await tab.dispatchEvent('body', 'drop', { dataTransfer });
  return {};
}

/** Fails as engines do: in code that nobody waits for, on the console, or in a call of the browser's. */
const fail = ({ how, text }) =>
  tab.evaluate(
    ([way, said]) => {
      const ways = {
        rejection: () => void Promise.reject(new RangeError(said)),
        console: () => console.error('frameUpdate error', new RangeError(said)),
        event: () => void setTimeout(() => { throw new RangeError(said); }),
      };
      ways[way]();
      return {};
    },
    [how, text],
  );

const requests = { open, fail, release: () => release(), settle, state, message, picture, screenshot, click, targets, middle, press, fill, drag, drop };
for await (const line of createInterface({ input: process.stdin })) {
  const { do: name, ...request } = JSON.parse(line);
  const answer = await requests[name](request).catch((error) => ({ error: String(error?.message ?? error) }));
  process.stdout.write(JSON.stringify(answer) + '\n');
}
await browser.close();
