// Moves the camera by mouse, touch and keys: around a point (orbit), or from where it is (fly). Up is +y, nothing rolls.
import { Vector3 } from 'three';

const STEEPEST = (89.9 * Math.PI) / 180;
const TURN = 0.005; // radians a pixel
const ZOOM = 0.001; // of the logarithm of the distance, a unit of the wheel
const STRIDES = 0.5; // radii of the scene a second
const FASTER = 5;
const MOVES = {
  KeyW: [0, 0, -1], ArrowUp: [0, 0, -1], KeyS: [0, 0, 1], ArrowDown: [0, 0, 1],
  KeyA: [-1, 0, 0], ArrowLeft: [-1, 0, 0], KeyD: [1, 0, 0], ArrowRight: [1, 0, 0],
  KeyQ: [0, -1, 0], KeyE: [0, 1, 0],
};

export class Controls {
  /** @param onInput is called when somebody moves the camera. */
  constructor(canvas, camera, onInput) {
    Object.assign(this, { canvas, camera, onInput, mode: 'orbit', radius: 1 });
    this.eye = new Vector3();
    this.yaw = this.pitch = 0;
    this.distance = 1;
    this.pointers = new Map();
    this.keys = new Set();
    canvas.addEventListener('pointerdown', (event) => this.press(event));
    canvas.addEventListener('pointermove', (event) => this.drag(event));
    for (const name of ['pointerup', 'pointercancel']) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    canvas.addEventListener('wheel', (event) => this.wheel(event), { passive: false });
    window.addEventListener('blur', () => this.keys.clear());
  }

  get forward() {
    const flat = Math.cos(this.pitch);
    return new Vector3(Math.sin(this.yaw) * flat, Math.sin(this.pitch), -Math.cos(this.yaw) * flat);
  }

  get target() {
    return this.forward.multiplyScalar(this.distance).add(this.eye);
  }

  /** Puts the camera at a point, looking at another. */
  place(eye, target) {
    this.eye.copy(eye);
    const ahead = target.clone().sub(eye);
    this.distance = ahead.length() || 1;
    ahead.divideScalar(this.distance);
    this.pitch = Math.max(-STEEPEST, Math.min(STEEPEST, Math.asin(Math.max(-1, Math.min(1, ahead.y)))));
    this.yaw = Math.atan2(ahead.x, -ahead.z);
    this.apply();
  }

  /** Takes over a camera that something else has moved, at the same distance from its target. */
  adopt() {
    const ahead = new Vector3();
    this.camera.getWorldDirection(ahead);
    this.place(this.camera.position, ahead.multiplyScalar(this.distance).add(this.camera.position));
  }

  apply() {
    this.camera.position.copy(this.eye);
    this.camera.up.set(0, 1, 0);
    this.camera.lookAt(this.target);
    this.camera.updateMatrixWorld(true);
  }

  /** Turns around the target, or around the eye. */
  turn(dx, dy) {
    const target = this.target;
    this.yaw += dx * TURN;
    this.pitch = Math.max(-STEEPEST, Math.min(STEEPEST, this.pitch - dy * TURN));
    if (this.mode === 'orbit') this.eye.copy(target).addScaledVector(this.forward, -this.distance);
    this.apply();
  }

  /** Moves with the pointer, in the plane of the picture. */
  pan(dx, dy) {
    const scale = (2 * this.distance * Math.tan((this.camera.fov * Math.PI) / 360)) / this.canvas.clientHeight;
    this.eye.add(new Vector3(-dx * scale, dy * scale, 0).applyQuaternion(this.camera.quaternion));
    this.apply();
  }

  /** Nearer to the target, or ahead. */
  zoom(amount) {
    if (this.mode === 'orbit') {
      const target = this.target;
      this.distance = Math.max(1e-4 * this.radius, this.distance * Math.exp(amount));
      this.eye.copy(target).addScaledVector(this.forward, -this.distance);
    } else {
      this.eye.addScaledVector(this.forward, -amount * this.radius);
    }
    this.apply();
  }

  press(event) {
    this.canvas.focus();
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, pans: event.button !== 0 || event.shiftKey });
  }

  drag(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) return;
    this.onInput();
    const [dx, dy] = [event.clientX - pointer.x, event.clientY - pointer.y];
    const others = [...this.pointers.values()].filter((other) => other !== pointer);
    if (others.length) {
      const apart = (x, y) => Math.hypot(x - others[0].x, y - others[0].y) || 1;
      this.zoom(Math.log(apart(pointer.x, pointer.y) / apart(event.clientX, event.clientY)));
      this.pan(dx / 2, dy / 2);
    } else if (pointer.pans) {
      this.pan(dx, dy);
    } else {
      this.turn(dx, dy);
    }
    Object.assign(pointer, { x: event.clientX, y: event.clientY });
  }

  wheel(event) {
    event.preventDefault();
    this.onInput();
    const lines = event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1;
    this.zoom(event.deltaY * lines * ZOOM);
  }

  /** Whether a key moves the camera. */
  key(event, isDown) {
    if (!(event.code in MOVES) || event.ctrlKey || event.metaKey || event.altKey) return false;
    if (isDown) this.keys.add(event.code);
    else this.keys.delete(event.code);
    this.faster = event.shiftKey;
    return true;
  }

  /** Moves by the keys that are held, for some seconds. */
  update(seconds) {
    if (!this.keys.size) return;
    this.onInput();
    const step = new Vector3();
    for (const code of this.keys) step.add(new Vector3(...MOVES[code]));
    const length = STRIDES * this.radius * Math.min(seconds, 0.1) * (this.faster ? FASTER : 1);
    this.eye.add(step.applyQuaternion(this.camera.quaternion).setLength(step.lengthSq() ? length : 0));
    this.apply();
  }
}
