// The page: a stage, which draws with Spark, PlayCanvas or CesiumJS, the camera, and the panel that steers both.
import { PerspectiveCamera, Quaternion, Vector3 } from 'three';
import { Controls } from './controls.js';
import { clearMessage, copyField, covered, drawLegend, element, listFiles, listen, notice, onDrop, showPanel } from './panel.js';
import { readPath } from './paths.js';
import { Player } from './player.js';
import { axis, cameraText, direction, whole } from './text.js';

const UP = new Vector3(0, 1, 0);
const LEAST_BUDGET = 1000;
const BUDGET_STEPS = 1000;
const SMOOTHING = 0.1; // share of a frame in the frame time that is shown
const FRAMED = 16 / 9; // width to height that the first look was chosen for

/** The turn that makes a direction +y, which is up for three. */
export function upright(up) {
  const from = new Vector3(...up).normalize();
  return from.y < -1 + 1e-9 ? new Quaternion(1, 0, 0, 0) : new Quaternion().setFromUnitVectors(from, UP);
}

class View {
  constructor(settings, Stage) {
    this.settings = settings;
    this.canvas = element('canvas');
    this.stage = new Stage(this.canvas, settings);
    this.camera = new PerspectiveCamera(settings.start.fov, 1, 0.01, 1000);
    this.turned = new Quaternion(); // from the splats to what is drawn
    this.radius = settings.start.radius;
    this.player = new Player(this.camera, this.turned);
    this.controls = new Controls(this.canvas, this.camera, () => this.leavePath());
    this.controls.radius = this.radius;
    this.camera.near = 1e-3 * this.radius;
    this.camera.far = 1e5 * this.radius;
    this.files = settings.files.map((file) => this.stage.add(file, (shown) => this.update(shown), notice));
    this.update = listFiles(this.files, (shown, visible) => shown.show(visible));
    this.frameTime = null;
    this.up = settings.up;
    this.setUp(this.up);
  }

  // --- the camera

  /** Positions in the space of the splats. */
  toSplats(point) {
    return point.clone().applyQuaternion(this.turned.clone().invert()).toArray();
  }

  toView(values) {
    return new Vector3(...values).applyQuaternion(this.turned);
  }

  setUp(up) {
    const kept = this.cameraNow?.();
    this.up = up;
    this.turned.copy(upright(up));
    this.stage.turn(this.turned);
    if (kept) this.controls.place(this.toView(kept.eye), this.toView(kept.target));
  }

  /** The first look; from farther away where less of the window is free than it was chosen for. */
  reset() {
    const { eye, target, fov, chosen } = this.settings.start;
    this.leavePath();
    this.camera.fov = fov;
    this.resize();
    const [at, to] = [this.toView(eye), this.toView(target)];
    const [right, below] = covered();
    const [width, height] = [window.innerWidth, window.innerHeight];
    const share = Math.min(1, (width - right) / (FRAMED * height), (height - below) / height);
    if (chosen) at.sub(to).divideScalar(share).add(to);
    this.controls.place(at, to);
  }

  cameraNow() {
    const ahead = new Vector3();
    this.camera.getWorldDirection(ahead);
    const { position } = this.camera;
    const target = ahead.multiplyScalar(this.controls.distance).add(position);
    return { eye: this.toSplats(position), target: this.toSplats(target), fov: this.camera.fov, up: this.up };
  }

  setMode(mode) {
    this.controls.mode = mode;
    for (const id of ['orbit', 'fly']) element(id).setAttribute('aria-pressed', String(id === mode));
  }

  /** Fills the window, with the middle of the picture in the middle of what the panel leaves free. */
  resize() {
    const ratio = element('pixels').checked ? window.devicePixelRatio : 1;
    const [width, height] = [window.innerWidth, window.innerHeight];
    const [right, below] = covered();
    this.stage.resize(ratio, width, height);
    this.camera.setViewOffset(width, height, right / 2, below / 2, width, height);
  }

  // --- the budget

  get treeSplats() {
    return this.files.reduce((sum, { file, builds }) => sum + (file.leaves ?? (builds ? file.splats : 0)), 0);
  }

  /** The budget at a place of the slider, 0..1, on a scale of equal ratios. */
  budgetAt(place) {
    const most = Math.max(this.treeSplats, 2 * LEAST_BUDGET);
    return Math.round(LEAST_BUDGET * (most / LEAST_BUDGET) ** place);
  }

  setBudget(place) {
    const all = place >= 1;
    const trees = this.treeSplats > 0;
    this.place = Math.max(0, Math.min(1, place));
    const budget = this.budgetAt(this.place);
    // A cut of all leaves needs no more than that, but Spark stops a little before its budget.
    this.stage.budget = all ? 2 * budget : budget;
    element('budget').value = String(BUDGET_STEPS * this.place);
    element('budget').disabled = !trees;
    element('budget-text').textContent = trees ? (all ? `${whole(budget)} (all)` : whole(budget)) : 'no tree';
  }

  firstBudget() {
    // CesiumJS goes by errors on the screen, and has no colours of levels.
    element('detail').hidden = this.stage.defaultBudget === null;
    if (this.stage.defaultBudget === null) return;
    const budget = this.settings.budget ?? this.stage.defaultBudget;
    const most = this.budgetAt(1);
    this.setBudget(Math.log(budget / LEAST_BUDGET) / Math.log(most / LEAST_BUDGET));
    // As it was given, which the slider's steps might miss.
    if (budget < most) this.stage.budget = budget;
    if (budget < most && this.treeSplats) element('budget-text').textContent = whole(budget);
  }

  // --- colours, files

  setLevels(on) {
    this.stage.colorsByLevel = on;
    element('levels').checked = on;
    element('legend').hidden = !on;
  }

  async setBuild(on) {
    const plain = this.files.filter((shown) => !shown.isTree);
    for (const shown of plain) shown.builds = on;
    this.setBudget(this.place);
    await Promise.all(plain.map((shown) => shown.load()));
  }

  // --- camera paths

  async drop(files) {
    try {
      this.play(await readPath(files, this.settings.cameras, this.settings.up), files[0].name);
    } catch (error) {
      notice(`${files[0].name} cannot be played: ${error.message}`);
    }
  }

  play(path, name) {
    clearMessage();
    this.player.open(path);
    const count = path.frames.length;
    const seconds = this.player.duration;
    element('path-name').textContent = `${name}: ${path.format}, ${whole(count)} camera${count > 1 ? 's' : ''}${seconds ? `, ${seconds.toFixed(1)} s` : ''}`;
    element('path').hidden = false;
    element('no-path').hidden = true;
    if (path.notes.length) notice(path.notes.join(' '));
  }

  togglePlay() {
    if (this.player.frames) this.player.playing = !this.player.playing;
  }

  scrub(share) {
    this.player.playing = false;
    this.player.seek(share * this.player.duration);
  }

  /** Stops playing; the camera stays where the path has left it. */
  leavePath() {
    if (!this.player.frames) return;
    this.player.close();
    this.controls.adopt();
    element('path').hidden = true;
    element('no-path').hidden = false;
  }

  // --- every frame

  frame(now) {
    const passed = this.last === undefined ? 0 : now - this.last;
    this.last = now;
    this.player.update(passed / 1000);
    this.controls.update(passed / 1000);
    this.stage.draw(this.camera);
    if (passed > 0) this.frameTime = this.frameTime === null ? passed : this.frameTime + SMOOTHING * (passed - this.frameTime);
    this.report();
  }

  report() {
    const set = (id, text) => {
      if (element(id).textContent !== text) element(id).textContent = text;
    };
    set('drawn', whole(this.stage.drawn));
    if (this.frameTime) {
      const digits = this.frameTime < 10 ? 1 : 0;
      set('frame-time', `${this.frameTime.toFixed(digits)} ms (${Math.round(1000 / this.frameTime)} fps)`);
    }
    const { chunks } = this.stage;
    element('chunks-row').hidden = !chunks;
    if (chunks) set('chunks', chunks.map(whole).join(' of '));
    const text = cameraText(this.cameraNow(), this.radius);
    if (element('camera').value !== text) element('camera').value = text;
    if (!this.player.frames) return;
    set('play', this.player.playing ? 'Pause' : 'Play');
    if (this.player.playing && this.player.duration) element('scrub').value = String((1000 * this.player.time) / this.player.duration);
  }

  async copy() {
    const done = await copyField(element('camera'));
    element('copy').textContent = done ? 'Copied' : 'Press Ctrl+C';
    setTimeout(() => (element('copy').textContent = 'Copy'), 1500);
  }
}

/** The choices of what is up: the axes, and what was given, if it is none of them. */
function listUps(up) {
  const names = ['-y', 'y', '-z', 'z', '-x', 'x'];
  if (!names.includes(axis(up))) names.push(axis(up));
  const options = names.map((name) => new Option(`${name} is up`, name, false, name === axis(up)));
  element('up').replaceChildren(...options);
}

export async function view(settings, Stage) {
  const page = new View(settings, Stage);
  const { versions, source } = settings.libraries;
  const names = Object.entries(versions).map(([name, version]) => `${name} ${version}`);
  element('about').textContent = `sparklod ${settings.version}, ${names.join(', ')} from ${source}`;
  element('title').textContent = element('title').title = settings.title;
  element('build-row').hidden = page.files.every((shown) => shown.isTree);
  element('pixels-row').hidden = window.devicePixelRatio === 1;
  drawLegend(page.stage.legend);
  listUps(settings.up);
  clearMessage();
  showPanel(true);
  page.reset();
  page.firstBudget();

  const hide = () => showPanel(element('panel').hidden);
  const help = () => element('help').showModal();
  const clicks = {
    orbit: () => page.setMode('orbit'),
    fly: () => page.setMode('fly'),
    reset: () => page.reset(),
    copy: () => page.copy(),
    play: () => page.togglePlay(),
    'path-close': () => page.leavePath(),
    'help-open': help,
    'panel-hide': hide,
    'panel-show': hide,
  };
  const changes = {
    budget: ({ value }) => page.setBudget(value / BUDGET_STEPS),
    levels: ({ checked }) => page.setLevels(checked),
    build: ({ checked }) => page.setBuild(checked),
    pixels: () => page.resize(),
    up: ({ value }) => page.setUp(direction(value) ?? settings.up),
    scrub: ({ value }) => page.scrub(value / 1000),
  };
  const keys = {
    o: clicks.orbit,
    f: clicks.fly,
    0: clicks.reset,
    l: () => page.setLevels(!page.stage.colorsByLevel),
    '[': () => page.setBudget(page.place - 0.05),
    ']': () => page.setBudget(page.place + 0.05),
    c: clicks.copy,
    ' ': clicks.play,
    h: hide,
    '?': help,
  };
  listen(clicks, changes, keys, (event, isDown) => page.controls.key(event, isDown));
  onDrop((files) => page.drop(files));
  window.addEventListener('resize', () => page.resize());
  new ResizeObserver(() => page.resize()).observe(element('panel'));

  page.stage.loop((now) => page.frame(now));
  if (settings.path) page.play(settings.path, settings.path.format);
  window.sparklod = page; // for whoever looks closer, in the console or in a test
  await Promise.all(page.files.map((shown) => shown.load()));
}
