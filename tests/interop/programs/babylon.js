// Draws with the Babylon.js scene of a page.
import { EngineStore } from '@babylonjs/core/Engines/engineStore.js';
import { Vector3 } from '@babylonjs/core/Maths/math.vector.js';
import { pixels } from './pixels.js';

/** Frames without anything new after which all is loaded and sorted. */
const QUIET = 10;

/** Splats that an instance of the mesh draws; the last one may have fewer. */
const SPLATS = 16;

const scene = EngineStore.LastCreatedScene;
const frames = []; // splats of each frame that drew another number of them, rounded up
let quiet = 0;

scene.onAfterRenderObservable.add(() => {
  const [mesh] = scene.meshes;
  if (!mesh?._readyToDisplay) return; // before the first sort it draws nothing
  const splats = SPLATS * mesh.forcedInstanceCount;
  const isNew = splats !== (frames.at(-1) ?? 0);
  if (isNew) frames.push(splats);
  quiet = isNew || mesh._sortIsDirty || !splats ? 0 : quiet + 1;
});

/** Waits for frames until all is there, and returns the last one. */
async function settled() {
  while (!scene.meshes.length) await new Promise(requestAnimationFrame);
  await scene.meshes[0].whenSettledAsync?.(QUIET); // what streams
  await scene.whenReadyAsync(); // shaders are compiled in the background, and nothing is drawn before
  quiet = 0;
  return new Promise((done) => {
    const observer = scene.onAfterRenderObservable.add(() => {
      if (quiet < QUIET) return;
      scene.onAfterRenderObservable.remove(observer);
      done(pixels(scene.getEngine()._gl));
    });
  });
}

/** Moves the camera of the page and waits: {pixels, frames}. */
window.draw = async ({ position, ahead, up, fovy, near, far }) => {
  const camera = scene.activeCamera;
  camera.position.copyFromFloats(...position);
  camera.upVector.copyFromFloats(...up);
  camera.setTarget(camera.position.add(Vector3.FromArray(ahead)));
  Object.assign(camera, { fov: fovy, minZ: near, maxZ: far });
  scene.clearColor.set(0, 0, 0, 1);
  return { pixels: await settled(), frames };
};
