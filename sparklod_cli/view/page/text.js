// Numbers and cameras as text.

/** "1,234,567". */
export const whole = (count) => Math.round(count).toLocaleString('en');

/** "2.9 MB". */
export const size = (bytes) => (bytes >= 1e9 ? `${(bytes / 1e9).toFixed(2)} GB` : bytes >= 1e5 ? `${(bytes / 1e6).toFixed(1)} MB` : `${(bytes / 1e3).toFixed(1)} kB`);

/** A number rounded to a share of 1/100,000 of some length, without zeros at its end. */
export function rounded(value, length) {
  const digits = Math.min(12, Math.max(0, Math.ceil(5 - Math.log10(length))));
  return String(Number(value.toFixed(digits)));
}

/** Three significant digits. */
export const short = (value) => String(Number(value.toPrecision(3)));

/** "-y" for (0, -1, 0); "x,y,z" for what is no axis. */
export function axis(up) {
  const at = up.findIndex((value) => Math.abs(value) === 1);
  const isAxis = at >= 0 && up.every((value, index) => index === at || value === 0);
  return isAxis ? (up[at] < 0 ? '-' : '') + 'xyz'[at] : up.map(String).join(',');
}

/** (0, -1, 0) for "-y"; null for anything else than an axis. */
export function direction(name) {
  const found = /^(-?)([xyz])$/.exec(name);
  return found && [...'xyz'].map((each) => (each === found[2] ? (found[1] ? -1 : 1) : 0));
}

/** The options with which `sparklod render` has the same camera; those at their defaults are left out. */
export function cameraText({ eye, target, fov, up }, radius) {
  const point = (values) => values.map((value) => rounded(value, radius)).join(',');
  const options = [`--look-at=${point(eye)}:${point(target)}`];
  if (Math.abs(fov - 60) > 1e-6) options.push(`--fov=${Number(fov.toFixed(4))}`);
  if (axis(up) !== '-y') options.push(`--up=${axis(up)}`);
  return options.join(' ');
}
