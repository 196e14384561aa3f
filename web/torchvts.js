// Depth by a plan in WebAssembly: torchvts/compiled/csrc/torchvts.h as a class. Works in browsers and in Node.

const REASON = 256;
const RGB8 = 0, FLOAT = 2;
const CONDITIONS = 22;
const KINDS = { f: Float32Array, d: Float64Array, i: BigInt64Array, b: Uint8Array };

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
    const file = this.take(bytes.length);
    new Uint8Array(library.memory.buffer).set(bytes, file);
    this.hold((reason) => library.vts_load(file, bytes.length, reason), file);
  }

  /** Holds what `make` gives, and frees what it was made of; throws the reason if it gives none. */
  hold(make, from) {
    const library = this.c, reason = this.take(REASON);
    this.handle = make(reason);
    const why = this.handle ? "" : this.text(reason);
    library.free(from), library.free(reason);
    if (!this.handle) throw new Error(why);
    Object.assign(this, this.facts());
    const pixels = this.height * this.width;
    this.image = this.take(12 * pixels);
    this.depth = this.take(4 * pixels);
    this.contact = this.take(pixels);
    this.conditions = this.take(4 * CONDITIONS);
    this.output = this.take(24);
    // vts_output: depth, normal, contact, deformed, gradient, conditions; 0 for what is not wanted
    new Uint32Array(library.memory.buffer, this.output, 6).set([this.depth, 0, this.contact, 0, 0, this.conditions]);
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
      file: [view.getUint32(28, true), view.getUint32(32, true)], // where its bytes lie, and how many
      about,
    };
    this.c.free(at);
    return found;
  }

  /** Puts an image where the library reads it; returns its format. */
  put(image) {
    const pixels = this.height * this.width, planes = image instanceof Float32Array;
    if (image.length !== (planes ? 3 : 4) * pixels) {
      const got = image.length / (planes ? 3 : 4);
      throw new Error(`Expected an image of ${this.width} x ${this.height} pixels, as the plan, got one of ${got} pixels.`);
    }
    if (planes) {
      new Float32Array(this.c.memory.buffer, this.image, 3 * pixels).set(image);
      return FLOAT;
    }
    const to = new Uint8Array(this.c.memory.buffer, this.image, 3 * pixels);
    for (let k = 0; k < pixels; k++) {
      to[3 * k] = image[4 * k];
      to[3 * k + 1] = image[4 * k + 1];
      to[3 * k + 2] = image[4 * k + 2];
    }
    return RGB8;
  }

  /** The plan of the same unit with another image without contact, see measure(). This one stays. */
  withBackground(image) {
    const format = this.put(image), made = Object.create(Plan.prototype);
    made.c = this.c;
    made.hold((reason) => this.c.vts_background(this.handle, this.image, format, reason), 0);
    return made;
  }

  /** The bytes of the plan's file. */
  bytes() {
    return new Uint8Array(this.c.memory.buffer, ...this.file).slice();
  }

  /** (3, height, width), linear light, which is value ** exponent. */
  get background() {
    return (this.light ??= this.table("background"));
  }

  get exponent() {
    return (this.power ??= this.table("exponent")[0]);
  }

  /** A table of the plan, by its name: docs/plan.md states how they lie. */
  table(name) {
    const bytes = this.bytes(), view = new DataView(bytes.buffer), lines = (size) => Math.ceil(size / 64) * 64;
    for (let at = 64 + lines(view.getUint32(28, true)); at < bytes.length; ) {
      const found = new TextDecoder().decode(bytes.subarray(at, at + 32)).replace(/\0.*/, "");
      const count = Number(view.getBigUint64(at + 40, true)), Values = KINDS[String.fromCharCode(bytes[at + 32])];
      if (found === name) return new Values(bytes.buffer, at + 64, count).slice();
      at += 64 + lines(count * Values.BYTES_PER_ELEMENT);
    }
    return null;
  }

  /** Depth in mm, contact and conditions of an image: bytes R, G, B, A (height, width, 4), as a canvas gives it, or Float32Array (3, height, width) in [0, 1]. */
  measure(image) {
    const pixels = this.height * this.width, format = this.put(image);
    const code = this.c.vts_depth(this.handle, this.image, format, this.output);
    if (code !== 0) throw new Error(this.text(this.c.vts_error(code)));
    return {
      depth: new Float32Array(this.c.memory.buffer, this.depth, pixels).slice(),
      contact: new Uint8Array(this.c.memory.buffer, this.contact, pixels).slice(),
      conditions: new Float32Array(this.c.memory.buffer, this.conditions, CONDITIONS).slice(),
    };
  }

  free() {
    for (const at of [this.image, this.depth, this.contact, this.conditions, this.output]) this.c.free(at);
    this.c.vts_free(this.handle);
  }
}
