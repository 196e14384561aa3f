// Depth by a plan in WebAssembly: torchvts/compiled/csrc/torchvts.h as a class. Works in browsers and in Node.

const REASON = 256;
const RGB8 = 0;

/** The compiled library; `bytes` of torchvts.wasm. */
export async function library(bytes) {
  const module = await WebAssembly.compile(bytes).catch(() => {
    throw new Error("This browser has no WebAssembly with SIMD: use a Chrome, Firefox or Safari of 2023 or later.");
  });
  const { exports } = await WebAssembly.instantiate(module);
  exports._initialize();
  return exports;
}

/** A plan of the bytes of its file, with memory for a frame. Throws the library's reason if it refuses. */
export class Plan {
  constructor(library, bytes) {
    this.c = library;
    const reason = this.take(REASON);
    const file = this.take(bytes.length);
    new Uint8Array(library.memory.buffer).set(bytes, file);
    this.handle = library.vts_load(file, bytes.length, reason);
    const why = this.handle ? "" : this.text(reason);
    library.free(file), library.free(reason);
    if (!this.handle) throw new Error(why);
    Object.assign(this, this.facts());
    const pixels = this.height * this.width;
    this.image = this.take(3 * pixels);
    this.depth = this.take(4 * pixels);
    this.contact = this.take(pixels);
    this.output = this.take(24);
    // vts_output: depth, normal, contact, deformed, gradient, conditions; 0 for what is not wanted
    new Uint32Array(library.memory.buffer, this.output, 6).set([this.depth, 0, this.contact, 0, 0, 0]);
  }

  take(bytes) {
    const at = this.c.malloc(bytes);
    if (!at) throw new Error("No memory is left for the plan: close other pages.");
    return at;
  }

  text(at) {
    const bytes = new Uint8Array(this.c.memory.buffer, at);
    return new TextDecoder().decode(bytes.slice(0, bytes.indexOf(0)));
  }

  facts() {
    const at = this.take(40);
    this.c.vts_info(this.handle, at);
    const view = new DataView(this.c.memory.buffer, at, 40);
    const about = JSON.parse(this.text(view.getUint32(24, true)));
    const found = {
      pitch: view.getFloat64(0, true),
      height: view.getInt32(8, true),
      width: view.getInt32(12, true),
      metric: view.getInt32(16, true) !== 0,
      about,
    };
    this.c.free(at);
    return found;
  }

  /** Depth in mm and contact of an image of bytes R, G, B, A (height, width, 4), as a canvas gives it. */
  measure(rgba) {
    const pixels = this.height * this.width;
    if (rgba.length !== 4 * pixels) {
      throw new Error(`Expected an image of ${this.width} x ${this.height} pixels, as the plan, got one of ${rgba.length / 4} pixels.`);
    }
    const to = new Uint8Array(this.c.memory.buffer, this.image, 3 * pixels);
    for (let k = 0; k < pixels; k++) {
      to[3 * k] = rgba[4 * k];
      to[3 * k + 1] = rgba[4 * k + 1];
      to[3 * k + 2] = rgba[4 * k + 2];
    }
    const code = this.c.vts_depth(this.handle, this.image, RGB8, this.output);
    if (code !== 0) throw new Error(this.text(this.c.vts_error(code)));
    return {
      depth: new Float32Array(this.c.memory.buffer, this.depth, pixels).slice(),
      contact: new Uint8Array(this.c.memory.buffer, this.contact, pixels).slice(),
    };
  }

  free() {
    for (const at of [this.image, this.depth, this.contact, this.output]) this.c.free(at);
    this.c.vts_free(this.handle);
  }
}
