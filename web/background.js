// The image without contact: whether the last frames are still and untouched, as find_background of torchvts says it, and that image.

export const ROUGH = 0.13;
const FRAMES = 12, PEDESTAL = 0.03, MOVED = 0.02, SAME_TYPE = 0.27, SAME_UNIT = 0.1;

function median(values) {
  const sorted = Float64Array.from(values).sort();
  return sorted[(sorted.length - 1) >> 1];
}

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

/** A plane blurred by a Gaussian along rows and columns, its border repeated. */
function blurred(plane, rows, columns, std) {
  const reach = Math.ceil(3 * std), weight = Array.from({ length: 2 * reach + 1 }, (_, k) => Math.exp(-0.5 * ((k - reach) / std) ** 2));
  const total = weight.reduce((a, b) => a + b, 0), within = (k, end) => Math.min(end - 1, Math.max(0, k));
  const along = (from, at) => {
    const out = new Float64Array(plane.length);
    for (let y = 0, k = 0; y < rows; y++) {
      for (let x = 0; x < columns; x++, k++) for (let j = -reach; j <= reach; j++) out[k] += (weight[j + reach] / total) * from[at(y, x, j)];
    }
    return out;
  };
  const across = along(plane, (y, x, j) => y * columns + within(x + j, columns));
  return along(across, (y, x, j) => within(y + j, rows) * columns + x);
}

/** channel_structure() of calibration/contacts.py: below 0.13 without contact. */
export function structure(planes, height, width) {
  const stride = Math.max(1, Math.floor(Math.min(height, width) / 120)), side = Math.floor(height / stride);
  const [light, rows, columns] = cells(planes, height, width, stride), n = rows * columns, squared = new Float64Array(n);
  const log = light.map((value) => Math.log(value + PEDESTAL));
  for (let c = 0; c < 3; c++) {
    const ratio = log.subarray(c * n, (c + 1) * n).map((value, k) => value - (log[k] + log[n + k] + log[2 * n + k]) / 3);
    const fine = blurred(ratio, rows, columns, side / 40), coarse = blurred(ratio, rows, columns, side / 16);
    for (let k = 0; k < n; k++) squared[k] += (fine[k] - coarse[k]) ** 2;
  }
  const margin = Math.min(Math.round(0.14 * rows), (Math.min(rows, columns) - 1) >> 1);
  const inner = squared.filter((_, k) => {
    const y = Math.floor(k / columns), x = k % columns;
    return y >= margin && y < rows - margin && x >= margin && x < columns - margin;
  }).sort();
  return Math.sqrt(inner[Math.round(0.99 * (inner.length - 1))]);
}

/** How far the light of an image is off that of the plan's background, in the median over the skin: 0.27 or less on one type of sensor, 0.1 on a unit. */
function strangeness(planes, plan) {
  const { height, width } = plan, cell = Math.max(1, Math.floor(Math.min(height, width) / 24));
  const logs = [plan.table("background"), planes].map((image) => cells(image, height, width, cell, (height % cell) >> 1, (width % cell) >> 1)[0].map((value) => Math.log(value + 0.01)));
  const n = logs[0].length / 3, off = logs[1].map((value, k) => value - logs[0][k]);
  const usual = [0, 1, 2].map((c) => median(off.subarray(c * n, (c + 1) * n)));
  return median(Array.from({ length: n }, (_, k) => Math.max(...usual.map((one, c) => Math.abs(off[c * n + k] - one)))));
}

/** Why an image is perhaps none of the plan's unit, or where that is not known, of the prior's sensor; "" where it is like it. */
export function doubtOf(planes, plan, known) {
  const off = strangeness(planes, plan), most = known ? SAME_UNIT : SAME_TYPE;
  if (off <= most) return "";
  const percent = (share) => `${Math.round(100 * share)} %`;
  return `its light is ${percent(off)} off that of ${plan.about.unit}, at most ${percent(most)} is usual: another sensor, turned or mirrored, or a camera whose colours the browser changes? Then depth is NOT in mm.`;
}

/** The last frames of a camera, in order: whether they show the skin at rest, and the image without contact. */
export class Resting {
  constructor(height, width) {
    Object.assign(this, { height, width, frames: [], cells: [] });
  }

  add(planes) {
    const side = Math.max(2, Math.floor(Math.min(this.height, this.width) / 20));
    this.frames.push(planes), this.cells.push(cells(planes, this.height, this.width, side)[0].map((value) => value + PEDESTAL));
    if (this.frames.length > FRAMES) this.frames.shift(), this.cells.shift();
  }

  /** Why the frames show no skin at rest, in a sentence; "" where they do. */
  why() {
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
    if (Math.max(...moved) >= 3) return "Something moves: keep the sensor still, and off everything.";
    const found = structure(this.frames.at(-1), this.height, this.width);
    return found <= ROUGH ? "" : `Something touches the skin (structure ${found.toFixed(2)}, without contact below ${ROUGH}): lift it off.`;
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
