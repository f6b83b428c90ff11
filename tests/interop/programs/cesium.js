// Draws with the CesiumJS widget of a page, whose first primitive is a tileset of splats.
import { Cartesian3, Matrix4, Scene } from 'cesium';
import { pixels } from './pixels.js';

/** Frames without anything new after which all is loaded and sorted. */
const QUIET = 10;

const scene = await new Promise((done) => {
  const { render } = Scene.prototype;
  Scene.prototype.render = function (...given) {
    Scene.prototype.render = render;
    done(this);
    return this.render(...given);
  };
});
const frames = []; // splats of each frame that drew another number of them
let quiet = 0;

scene.postRender.addEventListener(() => {
  const [tileset, splats] = drawn();
  const count = splats?._drawCommand ? splats._numSplats : 0;
  const isNew = count !== (frames.at(-1) ?? 0);
  if (isNew) frames.push(count);
  const loading = !tileset?.tilesLoaded || splats?._pendingSnapshot || splats?._needsSnapshotRebuild || splats?._dirty;
  quiet = loading || splats?._sorterState !== 0 || isNew || !count ? 0 : quiet + 1;
});

/** The tileset and what draws the splats of all of its tiles, as far as they are there. */
function drawn() {
  const tileset = scene.primitives.length ? scene.primitives.get(0) : undefined;
  return [tileset, tileset?.gaussianSplatPrimitive];
}

/** Waits for frames until all is there, and returns the last one. */
const settled = () =>
  new Promise((done, failed) => {
    scene.renderError.addEventListener((_scene, error) => failed(error));
    quiet = 0;
    const stop = scene.postRender.addEventListener(() => {
      if (quiet < QUIET) return;
      stop();
      done(pixels(scene.context._gl));
    });
  });

/** Moves the camera of the page in the frame of the tileset and waits: {pixels, frames}. */
window.draw = async ({ position, right, up, ahead, fov, near, far }) => {
  while (!drawn()[0]) await new Promise(requestAnimationFrame);
  const [tileset] = drawn();
  const { camera } = scene;
  camera.cancelFlight();
  const frame = tileset.root.computedTransform;
  Matrix4.multiplyByPoint(frame, Cartesian3.fromArray(position), camera.position);
  for (const [name, axis] of Object.entries({ direction: ahead, up, right }))
    Matrix4.multiplyByPointAsVector(frame, Cartesian3.fromArray(axis), camera[name]);
  Object.assign(camera.frustum, { fov, near, far });
  const [, splats] = drawn();
  if (splats) splats._hasLastSteadySortCameraPosition = false; // sorts anew even where the camera has hardly moved
  const read = await settled();
  const folder = new URL('.', document.baseURI).href;
  return { pixels: read, frames, tiles: tileset._selectedTiles.map(({ content }) => content.url.slice(folder.length)) };
};
