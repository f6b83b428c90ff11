// Colours splats by their feature size: Spark's nodes do not know their depth, but each is larger than its children.
import { dyno } from '@sparkjsdev/spark';
import { short } from './text.js';

/** Of viridis, from coarse to fine, as `sparklod render --color-by level` has it. */
const STOPS = ['414487', '355f8d', '2a788e', '21918c', '22a884', '44bf70', '7ad151', 'bddf26', 'fde725'];
const OCTAVES = 12; // from the radius of the scene down: 1/4096 of it
const BANDS = OCTAVES + 1;

const channels = (hex) => [0, 2, 4].map((at) => parseInt(hex.slice(at, at + 2), 16));

/** The colour of a band, 0 the coarsest, as 0..255. */
function bandColor(band) {
  const at = (band / (BANDS - 1)) * (STOPS.length - 1);
  const low = Math.min(Math.floor(at), STOPS.length - 2);
  const [from, to] = [channels(STOPS[low]), channels(STOPS[low + 1])];
  return from.map((value, index) => Math.round(value + (to[index] - value) * (at - low)));
}

const COLORS = Array.from({ length: BANDS }, (_, band) => bandColor(band));

export class SizeColors {
  /** @param radius of the scene, world units: the coarsest band. */
  constructor(radius) {
    this.radius = radius;
    this.amount = new dyno.DynoFloat({ value: 0 });
    this.largest = new dyno.DynoFloat({ value: radius });
    this.modifier = this.makeModifier();
  }

  get on() {
    return this.amount.value > 0;
  }

  set on(value) {
    this.amount.value = value ? 1 : 0;
  }

  makeModifier() {
    const table = COLORS.map((color) => `vec3(${color.map((value) => (value / 255).toFixed(5)).join(', ')})`);
    const types = { gsplat: dyno.Gsplat };
    return dyno.dynoBlock(types, types, ({ gsplat }) => {
      const recolor = new dyno.Dyno({
        inTypes: { gsplat: dyno.Gsplat, amount: 'float', largest: 'float' },
        outTypes: types,
        globals: () => [
          `vec3 sizeColor(vec3 scales, float largest) {
            vec3 table[${BANDS}] = vec3[${BANDS}](${table.join(', ')});
            float size = 2.0 / 3.0 * (scales.x + scales.y + scales.z);
            return table[clamp(int(floor(log2(largest / max(size, 1e-30)) + 0.5)), 0, ${BANDS - 1})];
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

  /** Fills the legend: a field for each band, coarse to fine, and some sizes. */
  drawLegend(bar, marks) {
    bar.replaceChildren(
      ...COLORS.map((color) => {
        const field = document.createElement('i');
        field.style.background = `rgb(${color.join(' ')})`;
        return field;
      }),
    );
    marks.replaceChildren(
      ...[0, OCTAVES / 2, OCTAVES].map((octave) => {
        const mark = document.createElement('span');
        mark.textContent = short(this.radius / 2 ** octave);
        return mark;
      }),
    );
  }
}
