// The image without contact: whether the last frames of a camera are still, whether something touches the skin, and that image.

import { leastSquares, median } from "./fit.js";

const FRAMES = 12, PEDESTAL = 0.03, MOVED = 0.02, SAME_TYPE = 0.27, SAME_UNIT = 0.1;
const LEAST_MM = 0.1, DEGREE = 4, ROUNDS = 10, TUKEY = 4.685, MARGIN = 0.05; // as in calibration/resting.py; at a margin, dark corners have no light to even

/** Means of square cells of planes (3, height, width), from `top` and `left` on: [(3, rows, columns), rows, columns]. */
function cells(planes, height, width, cell, top = 0, left = 0) {
  const rows = Math.floor((height - top) / cell), columns = Math.floor((width - left) / cell), means = new Float64Array(3 * rows * columns);
  for (let c = 0; c < 3; c++) {
    for (let y = 0; y < rows * cell; y++) {
      const at = (c * height + top + y) * width + left, to = (c * rows + Math.floor(y / cell)) * columns;
      for (let x = 0; x < columns * cell; x++) means[to + Math.floor(x / cell)] += planes[at + x] / (cell * cell);
    }
  }
  return [means, rows, columns];
}

/** Logarithm of the light of an image over that of the plan's background, by cells: { off: three of n values, x, y: of n cells, -1 to 1 }. */
function changeOf(planes, plan) {
  const { height, width, exponent } = plan, cell = Math.max(1, Math.floor(Math.min(height, width) / 24)), top = (height % cell) >> 1, left = (width % cell) >> 1;
  const [value, rows, columns] = cells(planes, height, width, cell, top, left), [rest] = cells(plan.background, height, width, cell, top, left), n = rows * columns;
  const off = value.map((one, k) => Math.log((one ** exponent + 0.01) / (rest[k] + 0.01)));
  const along = (start, end) => (k) => (2 * (start + (k + 0.5) * cell)) / end - 1, x = along(left, width), y = along(top, height);
  const each = [...Array(n).keys()];
  return { off: [0, 1, 2].map((c) => off.subarray(c * n, (c + 1) * n)), x: each.map((k) => x(k % columns)), y: each.map((k) => y(Math.floor(k / columns))) };
}

const PAIRS = [];
for (let i = 0; i <= DEGREE; i++) for (let j = 0; i + j <= DEGREE; j++) PAIRS.push([i, j]);

/** An image (3, height, width) without the smooth change of light that most of its skin shows, as _smooth() of resting.py finds it. */
function evened(planes, plan) {
  const { height, width, exponent } = plan, { off, x, y } = changeOf(planes, plan), out = new Float32Array(planes.length);
  const terms = x.map((_, k) => PAIRS.map(([i, j]) => x[k] ** i * y[k] ** j));
  let weight = null, fitted;
  for (let round = 0; round < ROUNDS; round++) {
    fitted = leastSquares(terms, off, weight);
    const left = off.map((one, c) => one.map((value, k) => value - terms[k].reduce((sum, term, t) => sum + term * fitted[c][t], 0)));
    const scale = left.map((one) => TUKEY * (median(one.map(Math.abs)) / 0.6745 + 1e-3));
    weight = x.map((_, k) => Math.max(0, 1 - left.reduce((sum, one, c) => sum + (one[k] / scale[c]) ** 2 / 3, 0)) ** 2);
  }
  fitted.forEach((one, c) => {
    for (let row = 0, to = c * height * width; row < height; row++) {
      const v = (2 * row + 1) / height - 1, along = Array(DEGREE + 1).fill(0);
      PAIRS.forEach(([i, j], t) => (along[i] += (one[t] * v ** j) / exponent));
      for (let column = 0; column < width; column++, to++) {
        const u = (2 * column + 1) / width - 1;
        out[to] = Math.min(1, planes[to] * Math.exp(-along.reduceRight((sum, part) => sum * u + part, 0)));
      }
    }
  });
  return out;
}

/** Why something touches the skin in an image: beside its own smooth light it reads as deep, as read_as_frame() of resting.py says it; or "". */
export function touchOf(planes, plan) {
  const { depth } = plan.measure(evened(planes, plan)), { height, width } = plan, margin = Math.round(MARGIN * Math.min(height, width));
  let most = 0, x = 0, y = 0;
  for (let row = margin; row < height - margin; row++) {
    for (let column = margin; column < width - margin; column++) {
      if (depth[row * width + column] > most) most = depth[row * width + column], x = column, y = row;
    }
  }
  return most < LEAST_MM ? "" : `Something touches the skin, which reads as ${most.toFixed(1)} mm deep around x ${x}, y ${y}: lift it off.`;
}

/** Why an image is perhaps none of the plan's unit, or where that is not known, of the prior's sensor; "" where it is like it. */
export function doubtOf(planes, plan, known) {
  const { off } = changeOf(planes, plan), usual = off.map(median), most = known ? SAME_UNIT : SAME_TYPE;
  const strange = median(off[0].map((_, k) => Math.max(...off.map((one, c) => Math.abs(one[k] - usual[c])))));
  if (strange <= most) return "";
  const percent = (share) => `${Math.round(100 * share)} %`;
  return `its light is ${percent(strange)} off that of ${plan.about.unit}, at most ${percent(most)} is usual: another sensor, turned or mirrored, or a camera whose colours the browser changes? Then depth is NOT in mm.`;
}

/** The last frames of a camera, in order: whether they show the skin at rest, and the image without contact. */
export class Resting {
  constructor() {
    Object.assign(this, { frames: [], cells: [] });
  }

  add(planes, { height, width }) {
    const side = Math.max(2, Math.floor(Math.min(height, width) / 20));
    this.frames.push(planes), this.cells.push(cells(planes, height, width, side)[0].map((value) => value + PEDESTAL));
    if (this.frames.length > FRAMES) this.frames.shift(), this.cells.shift();
  }

  /** Why the frames show no skin of the plan at rest, in a sentence; "" where they do. */
  why(plan) {
    const { cells } = this, count = cells.length, n = cells[0]?.length / 3, frames = [...cells.keys()];
    if (count < FRAMES) return `Waiting for ${FRAMES} frames: ${count} so far.`;
    const usual = cells[0].map((_, k) => median(cells.map((one) => one[k])));
    const ratio = cells.map((one) => one.map((value, k) => value / usual[k]));
    const level = ratio.map((one) => [0, 1, 2].map((c) => median(one.subarray(c * n, (c + 1) * n))));
    const change = Math.max(...[0, 1, 2].map((c) => Math.max(...level.map((one) => one[c])) - Math.min(...level.map((one) => one[c]))));
    if (change > MOVED) return `The light changes by ${(100 * change).toFixed(1)} %: wait until the LEDs and the exposure have settled.`;
    const relative = ratio.map((one, k) => one.map((value, at) => value / level[k][Math.floor(at / n)]));
    const off = relative.map((one) => one.map((value) => Math.abs(value - 1)));
    const spread = 1.4826 * median(off.flatMap((one) => Array.from({ length: n }, (_, k) => Math.max(one[k], one[n + k], one[2 * n + k]))));
    const limit = usual.map((_, at) => Math.max(MOVED, 8 * spread, 4 * median(frames.slice(1).map((k) => Math.abs(relative[k][at] - relative[k - 1][at])))));
    const moved = off.map((one) => Array.from({ length: n }, (_, k) => [0, 1, 2].some((c) => one[c * n + k] > limit[c * n + k])).filter(Boolean).length);
    return Math.max(...moved) >= 3 ? "Something moves: keep the sensor still, and off everything." : touchOf(this.frames.at(-1), plan);
  }

  /** The image without contact: of each value the mean of the middle half of the frames, in steps of 1 / 65535. */
  image() {
    const { frames } = this, quarter = frames.length >> 2, middle = frames.length - 2 * quarter, values = new Float32Array(frames.length);
    return frames[0].map((_, k) => {
      for (let j = 0; j < frames.length; j++) values[j] = frames[j][k];
      values.sort();
      let sum = 0;
      for (let j = quarter; j < quarter + middle; j++) sum += values[j];
      return Math.min(1, Math.max(0, Math.round((65535 * sum) / middle) / 65535));
    });
  }
}
