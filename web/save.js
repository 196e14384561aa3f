// Depth (height, width) in mm as a file: NPY, PNG or PLY, as torchvts writes and reads them.

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

/** 16-bit grey: value = 32768 + depth / 0.0001 mm. */
async function png(depth, height, width) {
  const lines = new Uint8Array(height * (1 + 2 * width)), head = new Uint8Array(13), view = new DataView(head.buffer);
  view.setUint32(0, width), view.setUint32(4, height), head.set([16], 8);
  depth.forEach((mm, k) => {
    const value = 32768 + Math.round(mm / 0.0001), at = Math.floor(k / width) * (1 + 2 * width) + 1 + 2 * (k % width);
    if (!(value >= 0 && value <= 65535)) throw new Error("A PNG holds depth from -3.27 to 3.27 mm, and this frame has more: save NPY or PLY.");
    lines[at] = value >> 8, lines[at + 1] = value & 255;
  });
  const packed = await new Response(new Blob([lines]).stream().pipeThrough(new CompressionStream("deflate"))).arrayBuffer();
  const parts = [chunk("IHDR", head), chunk("IDAT", new Uint8Array(packed)), chunk("IEND", new Uint8Array(0))];
  return [new Uint8Array([0x89, 0x50, 0x4e, 0x47, 13, 10, 26, 10]), ...parts];
}

/** The parts of a file of a kind, "npy", "png" or "ply". */
export function fileOf(kind, depth, { height, width, pitch, metric }) {
  return { npy, ply, png }[kind](depth, height, width, pitch, metric);
}
