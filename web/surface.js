// A depth map as a shaded surface that one turns, by WebGL 2.

import { COLOURS } from "./colour.js";

const VERTEX = `#version 300 es
precision highp sampler2D;
uniform sampler2D depth; uniform float pitch, times, zoom, aspect; uniform vec2 turn;
out vec3 normal; out float deep;
float at(ivec2 pixel) { return texelFetch(depth, clamp(pixel, ivec2(0), textureSize(depth, 0) - 1), 0).r; }
void main() {
  ivec2 pixels = textureSize(depth, 0), pixel = ivec2(gl_VertexID % pixels.x, gl_VertexID / pixels.x), x = ivec2(1, 0), y = ivec2(0, 1);
  vec2 size = vec2(pixels), flat_mm = (vec2(pixel) - 0.5 * (size - 1.0)) * pitch;
  deep = at(pixel);
  vec3 place = vec3(flat_mm.x, -flat_mm.y, deep * times); // as the camera sees it: the skin comes towards the eye
  normal = vec3(at(pixel - x) - at(pixel + x), at(pixel + y) - at(pixel - y), 2.0 * pitch / times);
  float c = cos(turn.x), s = sin(turn.x), d = cos(turn.y), e = sin(turn.y);
  vec3 round = vec3(c * place.x - s * place.y, s * place.x + c * place.y, place.z);
  vec3 seen = vec3(round.x, d * round.y + e * round.z, -e * round.y + d * round.z) * zoom / (max(size.x, 1.3 * size.y) * pitch);
  float fit = 1.5 * min(1.0, 1.3 / aspect);
  gl_Position = vec4(seen.x * fit, seen.y * fit * aspect, -0.3 * seen.z, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D colours; uniform float most;
in vec3 normal; in float deep;
out vec4 shown;
void main() {
  float light = 0.5 + 0.5 * dot(normalize(normal), normalize(vec3(-0.5, 0.6, 0.8)));
  shown = vec4(texture(colours, vec2(clamp(deep / most, 0.0, 1.0), 0.5)).rgb * light, 1.0);
}`;

function compiled(gl, kind, text) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}

export class Surface {
  constructor(canvas) {
    this.canvas = canvas;
    this.turn = [0.5, 0.95];
    this.zoom = 1;
    this.times = 3;
    const gl = canvas.getContext("webgl2", { antialias: true, alpha: true });
    if (!gl) throw new Error("This browser shows no 3D (WebGL 2): depth, profile and millimetres are below.");
    this.gl = gl;
    const program = gl.createProgram();
    gl.attachShader(program, compiled(gl, gl.VERTEX_SHADER, VERTEX));
    gl.attachShader(program, compiled(gl, gl.FRAGMENT_SHADER, FRAGMENT));
    gl.linkProgram(program);
    gl.useProgram(program);
    this.at = (name) => gl.getUniformLocation(program, name);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, COLOURS);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.activeTexture(gl.TEXTURE1), gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST), gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.uniform1i(this.at("depth"), 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.enable(gl.DEPTH_TEST);
    this.listen();
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  listen() {
    const { canvas } = this;
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      if (event.buttons) this.rotate(event.movementX / 150, event.movementY / 150);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.nearer(Math.exp(-event.deltaY / 600));
    }, { passive: false });
    const keys = {
      ArrowLeft: () => this.rotate(-0.1, 0), ArrowRight: () => this.rotate(0.1, 0), ArrowUp: () => this.rotate(0, -0.1),
      ArrowDown: () => this.rotate(0, 0.1), "+": () => this.nearer(1.1), "-": () => this.nearer(1 / 1.1),
    };
    canvas.addEventListener("keydown", (event) => {
      if (keys[event.key]) keys[event.key](), event.preventDefault();
    });
  }

  rotate(across, down) {
    this.turn = [this.turn[0] + across, Math.min(1.5, Math.max(0, this.turn[1] + down))];
    this.draw();
  }

  nearer(by) {
    this.zoom = Math.min(6, Math.max(0.4, this.zoom * by));
    this.draw();
  }

  /** Shows depth (height, width) in mm; `most` has the last colour. */
  show(depth, height, width, pitch, most) {
    const { gl } = this;
    if (this.width !== width || this.height !== height) {
      const index = new Uint32Array(6 * (height - 1) * (width - 1));
      for (let y = 0, k = 0; y < height - 1; y++) {
        for (let x = 0; x < width - 1; x++) {
          const at = y * width + x;
          for (const corner of [at, at + 1, at + width, at + 1, at + width + 1, at + width]) index[k++] = corner;
        }
      }
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, index, gl.STATIC_DRAW);
      this.count = index.length;
    }
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, width, height, 0, gl.RED, gl.FLOAT, depth);
    Object.assign(this, { height, width, pitch, most });
    this.draw();
  }

  clear() {
    this.gl.clear(this.gl.COLOR_BUFFER_BIT | this.gl.DEPTH_BUFFER_BIT);
    this.count = this.width = this.height = 0;
  }

  draw() {
    const { gl, canvas } = this;
    if (!this.count) return;
    const dense = window.devicePixelRatio || 1;
    canvas.width = canvas.clientWidth * dense, canvas.height = canvas.clientHeight * dense;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniform2f(this.at("turn"), ...this.turn);
    const numbers = { pitch: this.pitch, times: this.times, zoom: this.zoom, aspect: canvas.width / canvas.height, most: this.most };
    for (const [name, value] of Object.entries(numbers)) gl.uniform1f(this.at(name), value);
    gl.drawElements(gl.TRIANGLES, this.count, gl.UNSIGNED_INT, 0);
  }
}
