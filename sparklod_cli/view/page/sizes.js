// Colours splats by their feature size: Spark's nodes do not know their depth, but splats get smaller from level to level.
import { dyno } from '@sparkjsdev/spark';
import { short } from './text.js';

/** Of viridis, from coarse to fine, as `sparklod render --color-by level` has it. */
const STOPS = ['414487', '355f8d', '2a788e', '21918c', '22a884', '44bf70', '7ad151', 'bddf26', 'fde725'];
const [FEWEST, MOST] = [2, 20]; // bands, a factor of two each

const channels = (hex) => [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16));

/** The colour of a band of several, 0 the coarsest, as 0..255. */
function bandColor(band, count) {
  const at = (band / (count - 1)) * (STOPS.length - 1);
  const low = Math.min(Math.floor(at), STOPS.length - 2);
  const [from, to] = [channels(STOPS[low]), channels(STOPS[low + 1])];
  return from.map((value, index) => Math.round(value + (to[index] - value) * (at - low)));
}

export class SizeColors {
  /** @param sizes the smallest and the largest that are told apart, world units. */
  constructor([smallest, largest]) {
    const count = Math.max(FEWEST, Math.min(MOST, Math.round(Math.log2(largest / smallest)) + 1));
    this.colors = Array.from({ length: count }, (_, band) => bandColor(band, count));
    this.amount = new dyno.DynoFloat({ value: 0 });
    this.largest = new dyno.DynoFloat({ value: largest });
    this.modifier = this.makeModifier();
  }

  get on() {
    return this.amount.value > 0;
  }

  set on(value) {
    this.amount.value = value ? 1 : 0;
  }

  makeModifier() {
    const count = this.colors.length;
    const table = this.colors.map((color) => `vec3(${color.map((value) => (value / 255).toFixed(5)).join(', ')})`);
    const types = { gsplat: dyno.Gsplat };
    return dyno.dynoBlock(types, types, ({ gsplat }) => {
      const recolor = new dyno.Dyno({
        inTypes: { gsplat: dyno.Gsplat, amount: 'float', largest: 'float' },
        outTypes: types,
        globals: () => [
          `vec3 sizeColor(vec3 scales, float largest) {
            vec3 table[${count}] = vec3[${count}](${table.join(', ')});
            float size = 2.0 / 3.0 * (scales.x + scales.y + scales.z);
            return table[clamp(int(floor(log2(largest / max(size, 1e-30)) + 0.5)), 0, ${count - 1})];
          }`,
        ],
        statements: ({ inputs, outputs }) => [
          `${outputs.gsplat} = ${inputs.gsplat};`,
          `if (${inputs.amount} > 0.0) ${outputs.gsplat}.rgba.rgb = sizeColor(${inputs.gsplat}.scales, ${inputs.largest});`,
        ],
      });
      return { gsplat: recolor.apply({ gsplat, amount: this.amount, largest: this.largest }).gsplat };
    });
  }

  /** The colours of all bands, coarse to fine, and some of their sizes. */
  legend() {
    const last = this.colors.length - 1;
    const marks = [0, Math.round(last / 2), last].map((band) => short(this.largest.value / 2 ** band));
    return { colors: this.colors.map((color) => `rgb(${color.join(' ')})`), marks };
  }
}
