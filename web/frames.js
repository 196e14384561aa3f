// Frames of a camera: its stream, and the plan's images in them, as Sensor.rectify of torchvts cuts them.

const REASONS = {
  NotAllowedError: "The camera was refused. Allow it beside the address of the page, then press Start again.",
  NotFoundError: "No camera is connected. Plug the sensor in, then press Start again; or drop images or a video of it.",
  NotReadableError: "Another program has the camera. Close it, then press Start again.",
  OverconstrainedError: "That camera is gone. Choose another, or plug it in and press Start again.",
};

/** A camera's stream, near the size of raw frames that the plan knows. Rejects with a sentence. */
export async function openCamera(id, plan) {
  if (!navigator.mediaDevices?.getUserMedia) {
    throw new Error("No camera can be used here: browsers allow it on https and on localhost. Serve this folder by torchvts view --web, or drop images.");
  }
  const raw = plan.about.view?.raw_sizes ?? [];
  const [height, width] = raw.length ? raw.reduce((a, b) => (a[0] * a[1] < b[0] * b[1] ? a : b)) : [plan.height, plan.width];
  const video = { width: { ideal: width }, height: { ideal: height }, ...(id && { deviceId: { exact: id } }) };
  return navigator.mediaDevices.getUserMedia({ video }).catch((error) => {
    throw new Error(REASONS[error.name] ?? `The camera does not start (${error.message}). Plug it in again, then press Start.`);
  });
}

/** The cameras as [id, name]; names are known once one was allowed. */
export async function cameras() {
  const found = (await navigator.mediaDevices?.enumerateDevices?.()) ?? [];
  return found.filter(({ kind }) => kind === "videoinput").map(({ deviceId, label }, k) => [deviceId, label || `camera ${k + 1}`]);
}

/** For each of `to` pixels of a line the first of `from` pixels, and weights from there on: torch's bilinear resize with antialias, in its precision. */
function line(from, to) {
  const single = Math.fround, scale = single(from / to), reach = Math.max(scale, 1), inverse = single(1 / reach);
  return Array.from({ length: to }, (_, k) => {
    const center = single(scale * (k + 0.5)), first = Math.max(0, Math.trunc(center - reach + 0.5));
    const count = Math.min(from, Math.trunc(center + reach + 0.5)) - first;
    const weight = Array.from({ length: count }, (_, j) => Math.max(0, single(1 - Math.abs(single((single(j + first - center) + 0.5) * inverse)))));
    const sum = weight.reduce((a, b) => a + b, 0);
    return [first, weight.map((one) => one / sum)];
  });
}

/** Float32Array (3, rows.length, columns.length) of one (3, height, width) of the sizes that the lines were made from. */
function resized(planes, height, width, rows, columns) {
  const across = new Float32Array(3 * height * columns.length), out = new Float32Array(3 * rows.length * columns.length);
  for (let y = 0, to = 0; y < 3 * height; y++) {
    for (const [first, weight] of columns) {
      let sum = 0;
      for (let j = 0, at = y * width + first; j < weight.length; j++) sum += weight[j] * planes[at + j];
      across[to++] = sum;
    }
  }
  for (let c = 0, to = 0; c < 3; c++) {
    for (const [first, weight] of rows) {
      for (let x = 0; x < columns.length; x++) {
        let sum = 0;
        for (let j = 0, at = (c * height + first) * columns.length + x; j < weight.length; j++, at += columns.length) sum += weight[j] * across[at];
        out[to++] = Math.min(1, Math.max(0, sum));
      }
    }
  }
  return out;
}

/** Where the plan's image lies in frames of a size: [pixels of the frame, its height, its width], or null for all of it. */
function cut(plan, height, width, name) {
  const { view } = plan.about;
  const raw = view && (view.raw_sizes.some(([h, w]) => h === height && w === width) || (view.place && !view.raw_sizes.length));
  if (!raw && width === plan.width && height === plan.height) return null;
  if (!raw) {
    const sizes = (view?.raw_sizes ?? []).map(([h, w]) => `${w} x ${h}`).join(" or ");
    throw new Error(
      `${name}: expected ${plan.width} x ${plan.height} pixels, as the plan, ${sizes && `or raw frames of ${sizes}, `}got ${width} x ` +
        `${height}: open the plan of that camera, or images that torchvts has rectified.`,
    );
  }
  if (view.bent || view.place === "corners_px") {
    throw new Error(`${name}: this sensor's frames are straightened first, which the page cannot: torchvts stream --record writes images that it takes.`);
  }
  const turns = view.turn_deg / 90, [rows, columns] = turns % 2 ? [width, height] : [height, width];
  let [left, top, right, bottom] = view.extent_px.map(Math.trunc);
  if (!view.place) {
    top = Math.trunc(view.raw_crop * rows), left = Math.trunc(view.raw_crop * columns);
    bottom = rows - top - 1, right = columns - left - 1;
  }
  if (Math.min(left, top) < 0 || right >= columns || bottom >= rows) {
    throw new Error(`${name}: ${width} x ${height} does not hold the gel, which ends at ${right + 1}, ${bottom + 1}: another mode of the camera?`);
  }
  const at = [];
  for (let y = top; y <= bottom; y++) {
    for (let k = left; k <= right; k++) {
      const x = view.mirror ? columns - 1 - k : k;
      at.push([y * width + x, x * width + width - 1 - y, (height - 1 - y) * width + width - 1 - x, (height - 1 - x) * width + y][turns]);
    }
  }
  return [Uint32Array.from(at), bottom - top + 1, right - left + 1];
}

/** The plan's image, Float32Array (3, height, width) in [0, 1], of frames { data, width, height } of bytes R, G, B, A. */
export class Rectify {
  constructor(plan) {
    this.plan = plan;
  }

  image(frame, name = "image") {
    const { plan } = this;
    if (this.width !== frame.width || this.height !== frame.height) {
      this.cut = cut(plan, frame.height, frame.width, name);
      Object.assign(this, { width: frame.width, height: frame.height });
      if (this.cut) this.lines = [line(this.cut[1], plan.height), line(this.cut[2], plan.width)];
    }
    const [at, height, width] = this.cut ?? [null, plan.height, plan.width], pixels = height * width;
    const planes = new Float32Array(3 * pixels);
    for (let k = 0; k < pixels; k++) {
      const from = 4 * (at ? at[k] : k);
      for (let c = 0; c < 3; c++) planes[c * pixels + k] = frame.data[from + c] / 255;
    }
    return height === plan.height && width === plan.width ? planes : resized(planes, height, width, ...this.lines);
  }
}
