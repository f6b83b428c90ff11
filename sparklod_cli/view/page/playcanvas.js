// PlayCanvas in a canvas: what view.js draws Streamed SOG and GLB with. The members of Stage are those of spark.js.
import * as pc from 'playcanvas';
import { Quaternion } from 'three';
import { FileState } from './file_state.js';
import { direction, size, whole } from './text.js';
import { upright } from './view.js';

/** The colours that PlayCanvas gives to detail levels, the finest first; it repeats them. */
const COLORS = ['#f00', '#0f0', '#00f', '#ff0', '#f0f', '#0ff', '#ff8000', '#8000ff'];
const UNDERFILL = 10; // coarser levels are drawn while finer ones load
const REQUESTS = 100_000; // that the browser keeps the sizes of

class ShownFile extends FileState {
  constructor(app, file, changed, failed) {
    super(file, changed, failed);
    const { href } = new URL(file.url, document.baseURI);
    this.folder = href.slice(0, href.lastIndexOf('/') + 1);
    this.asset = new pc.Asset(file.name, file.levels === null ? 'container' : 'gsplat', { url: href });
    this.asset.on('error', (error) => this.fail(error));
    this.entity = new pc.Entity(file.name, app);
    this.app = app;
  }

  load() {
    this.app.assets.add(this.asset);
    this.app.root.addChild(this.entity);
    if (this.file.levels !== null) {
      this.entity.addComponent('gsplat', { asset: this.asset, unified: true });
    } else {
      this.asset.ready(({ resource }) => this.entity.addChild(resource.instantiateRenderEntity()));
      this.app.assets.load(this.asset);
    }
    this.report();
  }

  /** Turns the splats; the nodes of a GLB have turned them already. */
  turn(quaternion) {
    const back = this.file.levels === null ? upright(direction(this.file.up ?? 'y')).invert() : new Quaternion();
    const { x, y, z, w } = quaternion.clone().multiply(back);
    this.entity.setLocalRotation(x, y, z, w);
  }

  /** Says what it is, and how much of it has arrived. */
  report() {
    const { bytes, format, levels, leaves, splats } = this.file;
    const what = levels === null ? `${whole(splats)} splats` : `${levels} levels of ${whole(leaves)} splats`;
    const arrived = performance.getEntriesByType('resource').filter(({ name }) => name.startsWith(this.folder));
    const loaded = `${size(arrived.reduce((sum, entry) => sum + entry.encodedBodySize, 0))} of ${size(bytes)}`;
    this.say(this.loading ? `loading ${loaded}` : `${format}, ${loaded} loaded, ${what}`);
  }

  show(visible) {
    this.entity.enabled = visible;
    super.show(visible);
  }
}

export class Stage {
  constructor(canvas) {
    this.app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false } });
    this.app.setCanvasFillMode(pc.FILLMODE_NONE);
    this.app.setCanvasResolution(pc.RESOLUTION_AUTO);
    this.defaultBudget = this.app.scene.gsplat.splatBudget;
    // As Spark draws: small splats are fainter rather than left out, and turning the camera changes no order.
    const alike = { antiAlias: true, minPixelSize: 0, radialSorting: true };
    Object.assign(this.app.scene.gsplat, alike, { lodUnderfillLimit: UNDERFILL });
    this.camera = new pc.Entity('camera', this.app);
    this.camera.addComponent('camera', { clearColor: pc.Color.BLACK });
    this.app.root.addChild(this.camera);
    this.chunks = null;
    this.files = [];
    performance.setResourceTimingBufferSize(REQUESTS);
  }

  add(file, changed, failed) {
    this.files.push(new ShownFile(this.app, file, changed, failed));
    return this.files.at(-1);
  }

  turn(quaternion) {
    for (const shown of this.files) shown.turn(quaternion);
  }

  resize(ratio, width, height) {
    this.app.graphicsDevice.maxPixelRatio = ratio;
    this.app.resizeCanvas(width, height);
  }

  loop(act) {
    this.app.systems.gsplat.on('frame:ready', (_camera, _layer, ready, count) => {
      if (ready && !count && this.drawn) for (const shown of this.files) shown.loading = false;
      for (const shown of this.files) shown.report();
    });
    this.app.on('update', () => act(performance.now()));
    this.app.start();
  }

  /** Places the camera of the frame that PlayCanvas is about to draw. */
  draw({ position, quaternion, projectionMatrix, fov, near, far }) {
    this.camera.setPosition(position.x, position.y, position.z);
    this.camera.setRotation(quaternion.x, quaternion.y, quaternion.z, quaternion.w);
    Object.assign(this.camera.camera, { fov, nearClip: near, farClip: far });
    this.camera.camera.calculateProjection = (matrix) => matrix.data.set(projectionMatrix.elements);
  }

  get drawn() {
    return this.app.stats.frame.gsplats;
  }

  set budget(splats) {
    this.app.scene.gsplat.splatBudget = splats;
  }

  get colorsByLevel() {
    return this.app.scene.gsplat.colorizeLod;
  }

  set colorsByLevel(on) {
    this.app.scene.gsplat.colorizeLod = on;
  }

  get legend() {
    const count = Math.max(...this.files.map(({ file }) => file.levels));
    const levels = Array.from({ length: count }, (_, level) => level);
    const colors = levels.map((level) => COLORS[level % COLORS.length]);
    return { colors, marks: levels.map(String), text: 'Detail level of each region; 0 is full detail.' };
  }
}
