// CesiumJS in a canvas: what view.js draws 3D Tiles with. The members of Stage are those of spark.js.
import { Cartesian3, Cesium3DTileset, JulianDate, Matrix4, PerspectiveFrustum, Scene } from 'cesium';
import { Matrix4 as Turn, Quaternion, Vector3 } from 'three';
import { FileState } from './file_state.js';
import { direction, size, whole } from './text.js';
import { upright } from './view.js';

const Z_UP = new Quaternion(Math.SQRT1_2, 0, 0, Math.SQRT1_2); // from the axes of glTF to those of tiles, z up

class ShownFile extends FileState {
  constructor(scene, file, changed, failed) {
    super(file, changed, failed);
    this.scene = scene;
    this.tiles = new Set(); // in the last frame
    this.toTiles = Z_UP.clone().multiply(upright(direction(file.up ?? 'y'))); // from the axes of the splats
    this.turned = new Quaternion();
  }

  async load() {
    this.report();
    try {
      this.tileset = await Cesium3DTileset.fromUrl(new URL(this.file.url, document.baseURI).href);
    } catch (error) {
      this.fail(error);
      return;
    }
    this.tileset.show = this.visible;
    this.tileset.tileVisible.addEventListener((tile) => this.tiles.add(tile));
    this.tileset.tileFailed.addEventListener(({ message }) => this.fail(message));
    this.place();
    this.scene.primitives.add(this.tileset);
  }

  /** Has the scene stand where it stands for other engines, not where it is on the Earth. */
  place() {
    if (!this.tileset) return;
    const turn = new Turn().makeRotationFromQuaternion(this.turned.clone().multiply(this.toTiles.clone().invert()));
    const home = Matrix4.inverseTransformation(this.tileset.root.transform, new Matrix4());
    this.tileset.modelMatrix = Matrix4.multiplyTransformation(Matrix4.fromArray(turn.elements), home, home);
  }

  /** Splats of what is drawn, which follows the tiles that are seen some frames later. */
  get drawn() {
    return (this.visible && this.tileset?.gaussianSplatPrimitive?._numSplats) || 0;
  }

  /** Says what it is, and how much of it is drawn. */
  report() {
    const seen = [...this.tiles].reduce((sum, { content }) => sum + (content?.pointsLength ?? 0), 0);
    const late = !this.tileset?.tilesLoaded || (seen > 0 && seen !== this.drawn);
    this.loading = !this.bad && this.visible && late;
    const { bytes, format, levels, leaves } = this.file;
    const what = `${format}, ${size(bytes)}, ${levels} levels, ${whole(leaves)} splats`;
    this.say(this.loading ? `loading ${what}` : `${what}, ${whole(this.tiles.size)} tiles drawn`);
  }

  show(visible) {
    if (this.tileset) this.tileset.show = visible;
    super.show(visible);
  }
}

export class Stage {
  constructor(canvas) {
    const credits = document.createElement('div'); // of data, which come from the files alone
    this.scene = new Scene({ canvas, creditContainer: credits, contextOptions: { webgl: { antialias: false } }, msaaSamples: 1 });
    this.scene.screenSpaceCameraController.enableInputs = false;
    this.scene.camera.frustum = new PerspectiveFrustum();
    this.canvas = canvas;
    this.chunks = null;
    this.defaultBudget = null;
    this.legend = { colors: [], marks: [], text: '' };
    this.files = [];
  }

  add(file, changed, failed) {
    this.files.push(new ShownFile(this.scene, file, changed, failed));
    return this.files.at(-1);
  }

  turn(quaternion) {
    for (const shown of this.files) {
      shown.turned.copy(quaternion);
      shown.place();
    }
  }

  resize(ratio, width, height) {
    [this.canvas.width, this.canvas.height] = [Math.round(ratio * width), Math.round(ratio * height)];
  }

  loop(act) {
    const step = (now) => {
      act(now);
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  draw(seen) {
    const { camera } = this.scene;
    const [right, up, ahead] = [new Vector3(), new Vector3(), new Vector3()];
    seen.updateMatrixWorld();
    seen.matrixWorld.extractBasis(right, up, ahead);
    for (const [name, { x, y, z }] of Object.entries({ position: seen.position, right, up, direction: ahead.negate() }))
      Cartesian3.fromElements(x, y, z, camera[name]);
    const { elements } = seen.projectionMatrix;
    const [width, height] = [seen.near / elements[0], seen.near / elements[5]]; // half of those of the near plane
    Object.assign(camera.frustum, {
      aspectRatio: width / height,
      fov: 2 * Math.atan(Math.max(width, height) / seen.near),
      near: seen.near,
      far: seen.far,
      xOffset: elements[8] * width,
      yOffset: elements[9] * height,
    });
    for (const shown of this.files) shown.tiles.clear();
    this.scene.initializeFrame();
    this.scene.render(JulianDate.now());
    for (const shown of this.files) shown.report();
  }

  get drawn() {
    return this.files.reduce((sum, shown) => sum + shown.drawn, 0);
  }
}
