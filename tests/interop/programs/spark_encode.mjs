// Packs splats with Spark's JavaScript utilities: node spark_encode.mjs FOLDER IN OUT ENCODING
//
// FOLDER's node_modules holds @sparkjsdev/spark. IN is a raw file of float32, for each splat x y z, three scales,
// quaternion x y z w, opacity, r g b and 45 SH numbers, coefficient by coefficient. ENCODING is a `splatEncoding` as JSON.
// Writes OUT.NAME for each array: uint32 words, and in `packed-back` and `ext-back` the 14 float32 that Spark reads out
// of them again. Prints whether the machine has float16 arrays: Spark rounds to them, and cuts off where it has none.
//
// The module wants a page and three.js. The utilities want neither, but for three little classes of it; so they are taken
// out of the module's text, where every function and every constant starts a line.
import { readFileSync, writeFileSync } from 'node:fs';
import { join } from 'node:path';

const [folder, input, output, encodingText] = process.argv.slice(2);
const text = readFileSync(join(folder, 'node_modules/@sparkjsdev/spark/dist/spark.module.js'), 'utf8');

const CONSTANTS = `LN_SCALE_MIN LN_SCALE_MAX LN_SCALE_ZERO SCALE_ZERO f32buffer u32buffer supportsFloat16Array f16buffer
  u16buffer toHalf fromHalf tempQuaternion tempNormalizedQuaternion tempAxis packedCenter packedScales packedQuaternion
  packedColor packedFields`.split(/\s+/);
const FUNCTIONS = `floatBitsToUint$1 uintBitsToFloat$1 toHalfNative toHalfJS fromHalfNative fromHalfJS floatToUint8
  encodeQuatOctXy88R8 decodeQuatOctXy88R8 encodeQuatOctXy1010R12 decodeQuatOctXy1010R12 setPackedSplat unpackSplat
  encodeExtSplat decodeExtSplat packSint8Bytes encodeSh1Rgb encodeSh2Rgb encodeSh3Rgb encodeExtRgb`.split(/\s+/);

function statement(start) {
  const at = text.indexOf(`\n${start}`);
  if (at < 0) throw new Error(`this version of Spark has no line that starts with ${start}`);
  const end = text.slice(at + 1).match(/^.*(;|[^}\n]*\n(  .*\n)*\}.*)$/m); // one line, or up to the brace below it
  return end[0];
}

class Vector {
  set(x, y, z, w) {
    return Object.assign(this, { x, y, z, w });
  }
  copy({ x, y, z, w }) {
    return this.set(x, y, z, w);
  }
  divideScalar(s) {
    return this.set(this.x / s, this.y / s, this.z / s, this.w / s);
  }
  normalize() {
    return this.divideScalar(Math.hypot(this.x, this.y, this.z, this.w ?? 0));
  }
}
class Color {
  set(r, g, b) {
    return Object.assign(this, { r, g, b });
  }
}
const parts = [...FUNCTIONS.map((name) => statement(`function ${name}(`)), ...CONSTANTS.map((name) => statement(`const ${name} = `))];
const spark = new Function('THREE', `${parts.join('\n')}\nreturn { ${FUNCTIONS.join(', ')} };`)({
  Vector3: Vector,
  Quaternion: Vector,
  Color,
});

const NUMBERS = 14 + 45;
const bytes = readFileSync(input);
const splats = new Float32Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 4);
const count = splats.length / NUMBERS;
const encoding = JSON.parse(encodingText);
const words = (width) => new Uint32Array(count * width);
const arrays = { packed: words(4), sh1: words(2), sh2: words(4), sh3: words(4), ext0: words(4), ext1: words(4), 'ext-sh': words(15) };
const back = { 'packed-back': new Float32Array(count * 14), 'ext-back': new Float32Array(count * 14) };
const flat = ({ center: c, scales: s, quaternion: q, opacity, color }) =>
  [c.x, c.y, c.z, s.x, s.y, s.z, q.x, q.y, q.z, q.w, opacity, color.r, color.g, color.b];

for (let i = 0; i < count; ++i) {
  const splat = splats.subarray(i * NUMBERS, (i + 1) * NUMBERS);
  const sh = splat.subarray(14);
  const ext = [arrays.ext0, arrays.ext1];
  spark.setPackedSplat(arrays.packed, i, ...splat.subarray(0, 14), encoding);
  spark.encodeExtSplat(ext, i, ...splat.subarray(0, 14));
  spark.encodeSh1Rgb(arrays.sh1, i, sh.subarray(0, 9), encoding);
  spark.encodeSh2Rgb(arrays.sh2, i, sh.subarray(9, 24), encoding);
  spark.encodeSh3Rgb(arrays.sh3, i, sh.subarray(24), encoding);
  for (let k = 0; k < 15; ++k) arrays['ext-sh'][15 * i + k] = spark.encodeExtRgb(...sh.subarray(3 * k, 3 * k + 3));
  back['packed-back'].set(flat(spark.unpackSplat(arrays.packed, i, encoding)), 14 * i);
  back['ext-back'].set(flat(spark.decodeExtSplat(ext, i)), 14 * i);
}
for (const [name, values] of Object.entries({ ...arrays, ...back })) writeFileSync(`${output}.${name}`, values);
console.log('Float16Array' in globalThis ? 'rounds' : 'cuts');
