// Files, as torchvts writes and reads them: depth (height, width) in mm as NPY, PNG or PLY, and presses for a calibration.

const text = (value) => new TextEncoder().encode(value);

function npy(depth, height, width) {
  const head = new Uint8Array(128).fill(32);
  head.set([0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59, 1, 0, 118, 0]), head[127] = 10;
  head.set(text(`{'descr': '<f4', 'fortran_order': False, 'shape': (${height}, ${width}), }`), 10);
  return [head, depth];
}

/** Points in mm: x right, y up, z to the camera, row by row. */
function ply(depth, height, width, pitch, metric) {
  const points = new Float32Array(3 * depth.length);
  for (let k = 0; k < depth.length; k++) {
    const x = (k % width) - 0.5 * (width - 1), y = Math.floor(k / width) - 0.5 * (height - 1);
    points.set([x * pitch, -y * pitch, depth[k]], 3 * k);
  }
  const comment = `comment ${metric ? "mm" : "NOT mm: the scale of depth is not known"}, x right, y up, z to the camera`;
  const names = ["x", "y", "z"].map((name) => `property float ${name}`);
  return [text(["ply", "format binary_little_endian 1.0", comment, `element vertex ${depth.length}`, ...names, "end_header", ""].join("\n")), points];
}

function checksum(bytes) {
  let sum = -1;
  for (const byte of bytes) {
    sum ^= byte;
    for (let bit = 0; bit < 8; bit++) sum = (sum >>> 1) ^ (sum & 1 ? 0xedb88320 : 0);
  }
  return ~sum >>> 0;
}

function chunk(kind, bytes) {
  const out = new Uint8Array(12 + bytes.length), view = new DataView(out.buffer);
  view.setUint32(0, bytes.length), out.set(text(kind), 4), out.set(bytes, 8);
  view.setUint32(8 + bytes.length, checksum(out.subarray(4, 8 + bytes.length)));
  return out;
}

/** A PNG of 16 bits: samples (height, width, channels), one channel or R, G, B. */
async function png(samples, height, width) {
  const values = samples.length / height, lines = new Uint8Array(height * (1 + 2 * values)), head = new Uint8Array(13), view = new DataView(head.buffer);
  view.setUint32(0, width), view.setUint32(4, height), head.set([16, values === width ? 0 : 2], 8);
  samples.forEach((value, k) => lines.set([value >> 8, value & 255], Math.floor(k / values) * (1 + 2 * values) + 1 + 2 * (k % values)));
  const packed = await new Response(new Blob([lines]).stream().pipeThrough(new CompressionStream("deflate"))).arrayBuffer();
  const parts = [chunk("IHDR", head), chunk("IDAT", new Uint8Array(packed)), chunk("IEND", new Uint8Array(0))];
  return [new Uint8Array([0x89, 0x50, 0x4e, 0x47, 13, 10, 26, 10]), ...parts];
}

/** Grey: value = 32768 + depth / 0.0001 mm. */
function depthPng(depth, height, width) {
  const values = depth.map((mm) => 32768 + Math.round(mm / 0.0001));
  if (!values.every((value) => value >= 0 && value <= 65535)) throw new Error("A PNG holds depth from -3.27 to 3.27 mm, and this frame has more: save NPY or PLY.");
  return png(values, height, width);
}

/** The parts of a file of a kind, "npy", "png" or "ply". */
export function fileOf(kind, depth, { height, width, pitch, metric }) {
  return { npy, ply, png: depthPng }[kind](depth, height, width, pitch, metric);
}

/** Unsigned numbers [value, bytes], little endian. */
const little = (...fields) => Uint8Array.from(fields.flatMap(([value, bytes]) => Array.from({ length: bytes }, (_, k) => Math.floor(value / 256 ** k) % 256)));

/** A ZIP of files [name, bytes], stored as they are. */
function zip(files) {
  const parts = [], directory = [];
  let at = 0, size = 0;
  for (const [name, bytes] of files) {
    const title = text(name);
    const same = little([20, 2], [0, 2], [0, 2], [0, 2], [33, 2], [checksum(bytes), 4], [bytes.length, 4], [bytes.length, 4], [title.length, 2], [0, 2]);
    directory.push(little([0x02014b50, 4], [20, 2]), same, little([0, 4], [0, 2], [0, 4], [at, 4]), title);
    parts.push(little([0x04034b50, 4]), same, title, bytes);
    at += 30 + title.length + bytes.length, size += 46 + title.length;
  }
  return [...parts, ...directory, little([0x06054b50, 4], [0, 4], [files.length, 2], [files.length, 2], [size, 4], [at, 4], [0, 2])];
}

/** The parts of a ZIP that torchvts calibrate takes when it is unpacked: an image without contact, and presses { image, ball: mm }; images (3, height, width). */
export async function pressesOf(background, presses, { height, width }) {
  const pixels = height * width, file = async (name, planes) => {
    const samples = new Uint16Array(3 * pixels).map((_, k) => Math.round(65535 * planes[(k % 3) * pixels + Math.floor(k / 3)]));
    return [name, new Uint8Array(await new Blob(await png(samples, height, width)).arrayBuffer())];
  };
  const rows = presses.map(({ ball }, k) => `${k + 1},${ball}\n`), images = presses.map(({ image }, k) => file(`presses/${k + 1}/gelsight.png`, image));
  const catalog = ["presses/catalog.csv", text(["experiment_reldir,diameter(mm)\n", ...rows].join(""))];
  return zip([catalog, ...(await Promise.all([file("presses/background.png", background), ...images]))]);
}
