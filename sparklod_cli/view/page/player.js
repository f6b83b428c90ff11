// Plays a camera path: between its cameras, positions and fields of view change evenly, and turns along great circles.
import { Matrix4, Quaternion, Vector3 } from 'three';

const FPS = 30; // of paths without times

export class Player {
  /** @param toView the transform from the space of the splats to that of three's camera, a Quaternion. */
  constructor(camera, toView) {
    Object.assign(this, { camera, toView, frames: null, time: 0, playing: false });
  }

  get duration() {
    return this.frames?.at(-1).time ?? 0;
  }

  open(path) {
    const last = path.frames.at(-1).time;
    this.frames = path.frames.map((frame, number) => {
      const [position, turn] = [new Vector3(), new Quaternion()];
      new Matrix4().fromArray(frame.matrix).decompose(position, turn, new Vector3());
      return { position, turn, fov: frame.fov, time: last > 0 ? frame.time : number / FPS };
    });
    this.time = 0;
    this.playing = this.frames.length > 1;
    this.apply();
  }

  close() {
    this.frames = null;
    this.playing = false;
  }

  seek(time) {
    this.time = time;
    this.apply();
  }

  update(seconds) {
    if (!this.playing) return;
    this.time = this.duration > 0 ? (this.time + seconds) % this.duration : 0;
    this.apply();
  }

  /** Puts the camera where the path has it. */
  apply() {
    const { frames, camera } = this;
    const next = frames.findIndex((frame) => frame.time > this.time);
    const to = frames.at(next);
    const from = next > 0 ? frames[next - 1] : to;
    const share = to.time > from.time ? (this.time - from.time) / (to.time - from.time) : 0;
    camera.position.lerpVectors(from.position, to.position, share).applyQuaternion(this.toView);
    camera.quaternion.slerpQuaternions(from.turn, to.turn, share).premultiply(this.toView);
    camera.fov = from.fov + (to.fov - from.fov) * share;
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld(true);
  }
}
