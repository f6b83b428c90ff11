// Draws with the PlayCanvas application of a page, also if a viewer made it.
import * as pc from 'playcanvas';
import { pixels } from './pixels.js';

/** Frames without anything new after which all is loaded and sorted. */
const QUIET = 10;

const app = await (async () => {
  while (!pc.AppBase.getApplication()?.systems?.gsplat) await new Promise(requestAnimationFrame);
  return pc.AppBase.getApplication();
})();

const frames = []; // splats of each frame that drew another number of them
let quiet = 0;
let loading = true;
app.systems.gsplat.on('frame:ready', (_camera, _layer, ready, count) => (loading = !ready || count > 0));
app.on('frameend', () => {
  const splats = app.stats.frame.gsplats;
  const isNew = splats !== (frames.at(-1) ?? 0);
  if (isNew) frames.push(splats);
  quiet = loading || isNew || !splats ? 0 : quiet + 1;
  app.renderNextFrame = true; // SuperSplat's viewer stops drawing when nothing moves
});

/** Waits for frames until all is there, and returns the last one. */
const settled = () =>
  new Promise((done) => {
    quiet = 0;
    const look = () => {
      if (quiet < QUIET) return;
      app.off('frameend', look);
      done(pixels(app.graphicsDevice.gl));
    };
    app.on('frameend', look);
  });

/** Moves the camera of the page, if there is a pose, and waits: {pixels, frames}. */
window.draw = async ({ viewToWorld, fovy, near, far, settings }) => {
  Object.assign(app.scene.gsplat, settings);
  if (viewToWorld) {
    const [camera] = app.root.findComponents('camera');
    const pose = new pc.Mat4().set(viewToWorld);
    camera.entity.setPosition(pose.getTranslation());
    camera.entity.setRotation(new pc.Quat().setFromMat4(pose));
    Object.assign(camera, { fov: fovy, nearClip: near, farClip: far });
  }
  return { pixels: await settled(), frames };
};
