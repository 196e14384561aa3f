// The page: a plan and images, or a video, to depth in 3D, its profile, and millimetres under the cursor.

import { COLOURS } from "./colour.js";
import { Surface } from "./surface.js";
import { Plan, library } from "./torchvts.js";

const $ = (id) => document.getElementById(id);
export const state = { c: null, plan: null, images: [], at: 0, found: null, cross: null, video: null, surface: null };

function say(text, bad = false) {
  $("status").textContent = text;
  $("status").classList.toggle("bad", bad);
}

/** Runs what a person asked for; what goes wrong becomes a sentence. */
const told = (work) => async (...given) => {
  try {
    await work(...given);
  } catch (error) {
    say(error.message, true);
  }
};

const unit = () => (state.plan.metric ? "mm" : "(NOT mm: the scale of this unit is not known)");

// ---- measuring ----

function pixelsOf(source, width, height) {
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(source, 0, 0);
  return context.getImageData(0, 0, width, height);
}

function measure(source, width, height, name) {
  const { plan } = state;
  if (width !== plan.width || height !== plan.height) {
    throw new Error(
      `${name}: expected ${plan.width} x ${plan.height} pixels, as the plan, got ${width} x ${height}: open the plan of that ` +
        "camera, or images that torchvts has rectified.",
    );
  }
  const pixels = pixelsOf(source, width, height);
  const start = performance.now();
  const found = plan.measure(pixels.data);
  state.found = { ...found, pixels, ms: performance.now() - start };
  $("save").disabled = false;
  show();
}

// ---- showing ----

function show() {
  const { plan, found } = state;
  const { width, height } = plan;
  let most = 0, deepest = 0, touched = 0;
  found.depth.forEach((mm, k) => {
    if (mm > most) most = mm, deepest = k;
    touched += found.contact[k];
  });
  found.most = most > 0 ? most : 0.01;
  state.cross ??= [deepest % width, Math.floor(deepest / width)];
  const picture = new ImageData(width, height);
  found.depth.forEach((mm, k) => {
    const at = 4 * Math.round(255 * Math.min(1, Math.max(0, mm / found.most)));
    picture.data.set(COLOURS.subarray(at, at + 4), 4 * k);
  });
  found.picture = picture;
  $("most").textContent = `${found.most.toFixed(3)} ${plan.metric ? "mm" : "NOT mm"}`;
  const area = touched * plan.pitch * plan.pitch;
  $("what").textContent = `deepest ${most.toFixed(3)} ${unit()}, contact ${area.toFixed(1)} ${plan.metric ? "mm²" : ""}`;
  $("rate").textContent = `${width} x ${height}, measured in ${found.ms.toFixed(1)} ms`;
  state.surface?.show(found.depth, height, width, plan.pitch, found.most);
  drawMaps();
}

function drawMaps() {
  const { plan, found, cross } = state;
  if (!found) return;
  for (const [id, data] of [["image", found.pixels], ["depth", found.picture]]) {
    const canvas = $(id);
    if (canvas.width !== plan.width) canvas.width = plan.width;
    if (canvas.height !== plan.height) canvas.height = plan.height;
    const context = canvas.getContext("2d");
    context.putImageData(data, 0, 0);
    context.fillStyle = "rgba(255, 255, 255, 0.6)";
    context.fillRect(0, cross[1], plan.width, 1), context.fillRect(cross[0], 0, 1, plan.height);
  }
  const mm = found.depth[cross[1] * plan.width + cross[0]];
  $("under").textContent = `${mm.toFixed(3)} ${plan.metric ? "mm" : "NOT mm"} at x ${cross[0]}, y ${cross[1]}`;
  $("row").textContent = `along row ${cross[1]}, ${plan.metric ? "mm" : "NOT mm"}`;
  drawProfile();
}

function drawProfile() {
  const { plan, found, cross } = state;
  const canvas = $("profile"), dense = window.devicePixelRatio || 1, style = getComputedStyle(document.body);
  const w = (canvas.width = canvas.clientWidth * dense), h = (canvas.height = canvas.clientHeight * dense);
  const context = canvas.getContext("2d");
  const row = found.depth.subarray(cross[1] * plan.width, (cross[1] + 1) * plan.width), low = Math.min(0, ...row);
  const left = 44 * dense, below = 22 * dense, top = 6 * dense;
  const x = (k) => left + ((w - left - 8 * dense) * k) / (plan.width - 1);
  const y = (mm) => h - below - ((h - below - top) * (mm - low)) / (found.most - low);
  context.font = `${11 * dense}px system-ui`, context.fillStyle = style.getPropertyValue("--soft");
  context.strokeStyle = style.getPropertyValue("--line"), context.lineWidth = dense;
  context.textAlign = "right";
  for (const mm of [0, found.most / 2, found.most]) {
    context.beginPath(), context.moveTo(left, y(mm)), context.lineTo(w, y(mm)), context.stroke();
    context.fillText(mm.toFixed(2), left - 6 * dense, y(mm) + 4 * dense);
  }
  const across = plan.width * plan.pitch;
  for (const share of [0, 0.5, 1]) {
    context.textAlign = share === 0 ? "left" : share === 1 ? "right" : "center";
    context.fillText((share * across).toFixed(1), x(share * (plan.width - 1)), h - 6 * dense);
  }
  context.strokeStyle = style.getPropertyValue("--accent"), context.lineWidth = 2 * dense;
  context.beginPath();
  for (let k = 0; k < plan.width; k++) context.lineTo(x(k), y(row[k]));
  context.stroke();
}

// ---- files ----

function usePlan(bytes) {
  const plan = new Plan(state.c, bytes);
  state.plan?.free();
  Object.assign(state, { plan, found: null, cross: null, images: [], at: 0 });
  for (const id of ["what", "under", "row", "rate", "name", "most"]) $(id).textContent = "";
  for (const id of ["image", "depth", "profile"]) $(id).width = $(id).width; // clears it
  state.surface?.clear();
  $("back").disabled = $("next").disabled = $("save").disabled = true;
  const scale = plan.metric ? "lengths in mm" : "the scale is NOT known";
  $("scale").textContent = `${plan.about.unit || "a unit"}, ${plan.about.mode}, ${(plan.pitch * 1000).toFixed(0)} µm a pixel, ${scale}`;
}

async function showImage(at) {
  const { images } = state;
  state.at = (at + images.length) % images.length;
  const file = images[state.at];
  const bitmap = await createImageBitmap(file).catch(() => {
    throw new Error(`${file.name}: no image that this browser reads: PNG, JPEG and WebP are.`);
  });
  $("name").textContent = images.length > 1 ? `${file.name} (${state.at + 1} of ${images.length})` : file.name;
  $("back").disabled = $("next").disabled = images.length < 2;
  measure(bitmap, bitmap.width, bitmap.height, file.name);
}

function stopVideo() {
  if (!state.video) return;
  state.video.pause();
  URL.revokeObjectURL(state.video.src);
  state.video = null;
}

async function playVideo(file) {
  const video = document.createElement("video");
  Object.assign(video, { muted: true, loop: true, playsInline: true, src: URL.createObjectURL(file) });
  state.video = video;
  await new Promise((done, fail) => {
    video.onloadeddata = done;
    video.onerror = () => fail(new Error(`${file.name}: no video that this browser plays: MP4 (H.264) and WebM are.`));
  });
  $("name").textContent = file.name;
  $("back").disabled = $("next").disabled = true;
  let last = performance.now(), rate = 0;
  const frame = told(async () => {
    if (state.video !== video) return;
    measure(video, video.videoWidth, video.videoHeight, file.name);
    const now = performance.now();
    rate = 0.9 * rate + 0.1 * (1000 / Math.max(1, now - last)), last = now;
    $("rate").textContent += `, ${rate.toFixed(0)} frames a second`;
    video.requestVideoFrameCallback(frame);
  });
  video.requestVideoFrameCallback(frame);
  await video.play();
}

const open = told(async (files) => {
  const plan = files.find((file) => file.name.endsWith(".plan"));
  const video = files.find((file) => file.type.startsWith("video/"));
  const images = files.filter((file) => file.type.startsWith("image/"));
  if (!plan && !video && !images.length) throw new Error("Expected a plan (.plan), images or a video, got none of them.");
  stopVideo();
  if (plan) {
    usePlan(new Uint8Array(await plan.arrayBuffer()));
    say(`${plan.name} is in use. Now open images or a video of this unit.`);
  }
  if (video) return say(""), playVideo(video);
  if (images.length) {
    state.images = images.sort((a, b) => a.name.localeCompare(b.name, undefined, { numeric: true }));
    say("");
    await showImage(0);
  }
});

function saveDepth() {
  const { plan, found } = state;
  const text = `{'descr': '<f4', 'fortran_order': False, 'shape': (${plan.height}, ${plan.width}), }`;
  const head = new Uint8Array(128).fill(32);
  head.set([0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59, 1, 0, 118, 0]), head.set(new TextEncoder().encode(text), 10), head[127] = 10;
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([head, found.depth]));
  link.download = "depth_mm.npy";
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// ---- hands ----

function moveCross(x, y) {
  const { plan } = state;
  if (!state.found) return;
  const within = (value, end) => Math.min(end - 1, Math.max(0, Math.floor(value)));
  state.cross = [within(x, plan.width), within(y, plan.height)];
  drawMaps();
}

function listen() {
  for (const id of ["image", "depth"]) {
    $(id).addEventListener("pointermove", (event) => {
      const box = $(id).getBoundingClientRect();
      const across = (event.clientX - box.left) / box.width, down = (event.clientY - box.top) / box.height;
      moveCross(across * state.plan.width, down * state.plan.height);
    });
  }
  $("depth").addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (step && state.cross) moveCross(state.cross[0] + step[0], state.cross[1] + step[1]), event.preventDefault();
  });
  $("open").addEventListener("click", () => $("files").click());
  $("files").addEventListener("change", () => open([...$("files").files]));
  $("back").addEventListener("click", told(() => showImage(state.at - 1)));
  $("next").addEventListener("click", told(() => showImage(state.at + 1)));
  $("save").addEventListener("click", saveDepth);
  $("times").addEventListener("input", () => {
    $("timesOut").textContent = $("times").value;
    if (state.surface) state.surface.times = Number($("times").value), state.surface.draw();
  });
  const body = document.body;
  body.addEventListener("dragover", (event) => (event.preventDefault(), body.classList.add("drop")));
  body.addEventListener("dragleave", () => body.classList.remove("drop"));
  body.addEventListener("drop", (event) => {
    event.preventDefault(), body.classList.remove("drop");
    open([...event.dataTransfer.files]);
  });
  const again = () => state.found && drawProfile();
  new ResizeObserver(again).observe($("profile"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
}

async function bytesOf(name) {
  const answer = await fetch(name);
  if (!answer.ok) throw new Error(`${name} is missing beside this page: make web puts it there.`);
  return new Uint8Array(await answer.arrayBuffer());
}

told(async () => {
  state.c = await library(await bytesOf("torchvts.wasm"));
  $("bar").getContext("2d").putImageData(new ImageData(COLOURS.slice(), 256, 1), 0, 0);
  usePlan(await bytesOf("demo.plan"));
  const demo = new File([await bytesOf("demo.png")], "a drawn press", { type: "image/png" });
  say("A ball pressed into a drawn sensor. Drop a plan of your unit (pipe.freeze().save(\"unit.plan\")) and its images here.");
  try {
    state.surface = new Surface($("surface"));
  } catch (error) {
    say(error.message, true);
  }
  state.images = [demo];
  await showImage(0);
  listen();
  document.body.dataset.ready = "yes";
})();
