// Camera paths of files: the server parses all formats; a site without one reads sparklod's JSON and transforms.json.
import { Matrix4, Quaternion, Vector3 } from 'three';

const FLIP = new Matrix4().makeScale(1, -1, -1);
const degrees = (radians) => (radians * 180) / Math.PI;

/**
 * The path of some dropped files: {format, notes, frames: [{matrix, fov, time, name}]}, matrices column by column.
 * `up` is the up axis of cameras that have none.
 */
export async function readPath(files, server, up) {
  return server ? askServer(files, server) : parse(await files[0].text(), up);
}

async function askServer(files, address) {
  const contents = await Promise.all(files.map(async (file) => ({ name: file.name, data: await base64(file) })));
  const request = { method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify({ files: contents }) };
  const response = await fetch(address, request).catch(() => {
    throw new Error('the server does not answer; is it still running?');
  });
  const text = await response.text();
  if (response.ok || response.status === 422) {
    const answer = JSON.parse(text);
    if (answer.error) throw new Error(answer.error);
    return answer;
  }
  throw new Error(text.trim() || response.statusText);
}

function base64(file) {
  return new Promise((done, failed) => {
    const reader = new FileReader();
    reader.onload = () => done(reader.result.slice(reader.result.indexOf(',') + 1));
    reader.onerror = () => failed(reader.error);
    reader.readAsDataURL(file);
  });
}

/** Parses a file as far as a page can. */
export function parse(text, up) {
  let root;
  try {
    root = JSON.parse(text);
  } catch {
    root = null;
  }
  const own = root?.format === 'sparklod-camera-path';
  if (!Array.isArray(root?.frames) || !(own || root.frames[0]?.transform_matrix)) {
    const known = own ? 'keyframes are' : "this page reads sparklod's JSON and transforms.json; other formats are";
    throw new Error(`${known} read by sparklod view itself`);
  }
  const frames = root.frames.map((frame, number) => {
    const time = Number(frame.time ?? number / (root.fps ?? 30));
    const parsed = own ? ownFrame(frame, root, up) : transformsFrame(frame, root);
    const numbers = [...parsed.matrix, parsed.fov, time];
    if (!numbers.every(Number.isFinite)) throw new Error(`camera ${number} of it has a number that is none`);
    return { ...parsed, time, name: String(frame.name ?? '') };
  });
  if (!frames.length) throw new Error('it has no cameras');
  const first = frames[0].time;
  for (const frame of frames) frame.time -= first;
  return { format: own ? "sparklod's JSON" : 'transforms.json', notes: [], frames };
}

function ownFrame(frame, root, upOfScene) {
  const axes = root.axes ?? 'opengl-c2w';
  const [, height] = frame.size ?? root.size ?? [];
  const focal = frame.focal ?? root.focal;
  const fov = focal && height ? degrees(2 * Math.atan(height / 2 / focal[1])) : Number(frame.fov ?? root.fov ?? 60);
  if (frame.eye) {
    const up = new Vector3(...(frame.up ?? upOfScene));
    const eye = new Vector3(...frame.eye);
    const turned = new Matrix4().lookAt(eye, new Vector3(...frame.target), up).setPosition(eye);
    return { matrix: turned.toArray(), fov };
  }
  const one = new Vector3(1, 1, 1);
  const matrix = frame.matrix
    ? new Matrix4().set(...frame.matrix.flat())
    : new Matrix4().compose(new Vector3(...frame.position), new Quaternion(...frame.quat_xyzw).normalize(), one);
  if (axes.endsWith('w2c')) matrix.invert();
  if (axes.startsWith('opencv')) matrix.multiply(FLIP);
  return { matrix: matrix.toArray(), fov };
}

function transformsFrame(frame, root) {
  const height = frame.h ?? root.h;
  const focal = frame.fl_y ?? root.fl_y ?? frame.fl_x ?? root.fl_x;
  const across = frame.camera_angle_x ?? root.camera_angle_x;
  const width = frame.w ?? root.w;
  let fov = 60;
  if (focal && height) fov = degrees(2 * Math.atan(height / 2 / focal));
  else if (root.camera_angle_y) fov = degrees(root.camera_angle_y);
  else if (across && width && height) fov = degrees(2 * Math.atan((Math.tan(across / 2) * height) / width));
  else if (across) fov = degrees(across);
  return { matrix: new Matrix4().set(...frame.transform_matrix.flat()).toArray(), fov };
}
