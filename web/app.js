// The page: a plan and a camera, images or a video, to depth in 3D, its profile, and millimetres under the cursor.

import { ROUGH, Resting, doubtOf, structure } from "./background.js";
import { COLOURS } from "./colour.js";
import { Rectify, cameras, openCamera } from "./frames.js";
import { fileOf } from "./save.js";
import { Surface } from "./surface.js";
import { Plan, library } from "./torchvts.js";

const $ = (id) => document.getElementById(id);
// known: whether the plan has the background of this unit; planes: the image that is shown, (3, height, width); film: the video or camera that plays
export const state = { c: null, plan: null, known: true, plans: [], planes: null, images: [], at: 0, found: null, cross: null, film: null, frozen: false, surface: null };

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

/** Takes a frame as its source gives it: the image in it, and its depth where the background is known. */
function see(source, width, height, name) {
  state.raw = `${width} x ${height}`;
  state.planes = state.rectify.image(pixelsOf(source, width, height), name);
  measure();
}

function measure() {
  const { plan, planes } = state, n = plan.height * plan.width;
  const pixels = new ImageData(plan.width, plan.height);
  for (let k = 0; k < n; k++) {
    for (let c = 0; c < 3; c++) pixels.data[4 * k + c] = 255 * planes[c * n + k];
    pixels.data[4 * k + 3] = 255;
  }
  if (!state.known) {
    drawMap("image", pixels);
    $("take").disabled = Boolean(state.film?.resting);
    return;
  }
  const start = performance.now();
  const found = plan.measure(planes);
  state.found = { ...found, pixels, ms: performance.now() - start };
  $("save").disabled = $("download").disabled = $("take").disabled = false;
  show();
}

// ---- the background ----

/** The shown image, or the last frames of the camera, become the image without contact. */
function takeBackground() {
  const { plan, film } = state, image = film?.resting ? film.resting.image() : state.planes;
  if (!film?.resting && structure(image, plan.height, plan.width) > ROUGH) {
    throw new Error("Something touches the skin in this image: show one without contact, then take it.");
  }
  const made = plan.withBackground(image), doubt = doubtOf(image, plan, state.known);
  plan.free();
  Object.assign(state, { plan: made, known: true, rectify: new Rectify(made), background: image, found: null });
  measure();
  $("still").textContent = "";
  const check = film?.resting ? " Browsers may change a camera's colours: press one ball of known size before you trust the millimetres." : "";
  say(doubt ? `The background is taken, and in doubt: ${doubt}` : `The background is taken. Press something into the skin.${check}`, Boolean(doubt));
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
  found.deepest = [deepest % width, Math.floor(deepest / width)];
  const picture = new ImageData(width, height);
  found.depth.forEach((mm, k) => {
    const at = 4 * Math.round(255 * Math.min(1, Math.max(0, mm / found.most)));
    picture.data.set(COLOURS.subarray(at, at + 4), 4 * k);
  });
  found.picture = picture;
  $("most").textContent = `${found.most.toFixed(3)} ${plan.metric ? "mm" : "NOT mm"}`;
  const area = touched * plan.pitch * plan.pitch;
  $("what").textContent = `deepest ${most.toFixed(3)} ${unit()}, contact ${area.toFixed(1)} ${plan.metric ? "mm²" : ""}`;
  const cut = state.raw === `${width} x ${height}` ? "" : ` of ${state.raw}`;
  $("rate").textContent = `${width} x ${height}${cut}, measured in ${found.ms.toFixed(1)} ms`;
  state.surface?.show(found.depth, height, width, plan.pitch, found.most);
  drawMaps();
}

function drawMap(id, data) {
  const canvas = $(id);
  if (canvas.width !== data.width) canvas.width = data.width;
  if (canvas.height !== data.height) canvas.height = data.height;
  const context = canvas.getContext("2d");
  context.putImageData(data, 0, 0);
  return context;
}

/** Where the cross is: where a person put it, else at the deepest pixel. */
const crossed = () => state.cross ?? state.found.deepest;

function drawMaps() {
  const { plan, found } = state;
  if (!found) return;
  const cross = crossed();
  for (const [id, data] of [["image", found.pixels], ["depth", found.picture]]) {
    const context = drawMap(id, data);
    context.fillStyle = "rgba(255, 255, 255, 0.6)";
    context.fillRect(0, cross[1], plan.width, 1), context.fillRect(cross[0], 0, 1, plan.height);
  }
  const mm = found.depth[cross[1] * plan.width + cross[0]];
  $("under").textContent = `${mm.toFixed(3)} ${plan.metric ? "mm" : "NOT mm"} at x ${cross[0]}, y ${cross[1]}`;
  $("row").textContent = `along row ${cross[1]}, ${plan.metric ? "mm" : "NOT mm"}`;
  drawProfile();
}

function drawProfile() {
  const { plan, found } = state, cross = crossed();
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
    context.fillText(mm.toFixed(found.most < 0.1 ? 3 : 2), left - 6 * dense, y(mm) + 4 * dense);
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

// ---- plans ----

/** known: false for a prior, which knows the type of a sensor and not this unit's background. */
function usePlan(bytes, known = true) {
  const plan = new Plan(state.c, bytes);
  state.plan?.free();
  Object.assign(state, { plan, known, rectify: new Rectify(plan), planes: null, background: null, found: null, cross: null, images: [], at: 0 });
  for (const id of ["what", "under", "row", "rate", "name", "most"]) $(id).textContent = "";
  for (const id of ["image", "depth", "profile"]) $(id).width = $(id).width; // clears it
  state.surface?.clear();
  for (const id of ["back", "next", "save", "take", "download"]) $(id).disabled = true;
  const scale = plan.metric ? "lengths in mm" : "the scale is NOT known";
  $("scale").textContent = `${plan.about.unit || "a unit"}, ${plan.about.mode}, ${(plan.pitch * 1000).toFixed(0)} µm a pixel, ${scale}`;
}

const WITHOUT = "Lift everything off the skin and keep it still, then take the background. Start the camera, or drop an image without contact.";

/** A prior of the page, or a file of the user's. */
async function chooseType() {
  const { file, prior_deg, name } = state.plans[$("type").value] ?? {};
  if (!file) return $("files").click();
  stopFilm();
  usePlan(await bytesOf(file), prior_deg === null);
  if (state.known) return say(`${name}, is in use. Now start the camera, or open images or a video of this unit.`);
  say(`Depth by the prior of the type: normals of a unit that it has not seen are ${prior_deg.toFixed(1)} degrees off in the mean. ${WITHOUT}`);
}

// ---- files ----

async function showImage(at) {
  const { images } = state;
  state.at = (at + images.length) % images.length;
  const file = images[state.at];
  const bitmap = await createImageBitmap(file).catch(() => {
    throw new Error(`${file.name}: no image that this browser reads: PNG, JPEG and WebP are.`);
  });
  $("name").textContent = images.length > 1 ? `${file.name} (${state.at + 1} of ${images.length})` : file.name;
  $("back").disabled = $("next").disabled = images.length < 2;
  see(bitmap, bitmap.width, bitmap.height, file.name);
}

function stopFilm() {
  const { film } = state;
  if (!film) return;
  film.video.pause();
  film.stream?.getTracks().forEach((track) => track.stop());
  URL.revokeObjectURL(film.video.src);
  state.film = null, freeze(false);
  $("still").textContent = "", $("start").textContent = "Start", $("freeze").disabled = true;
}

/** Measures each frame of a video or a camera, until another takes its place. */
async function play(film, name) {
  const { video } = film;
  state.film = film;
  Object.assign(video, { muted: true, loop: true, playsInline: true });
  await new Promise((done, fail) => {
    video.onloadeddata = done;
    video.onerror = () => fail(new Error(`${name}: no video that this browser plays: MP4 (H.264) and WebM are.`));
    setTimeout(() => fail(new Error(`${name}: no frame came in 10 seconds. ${film.stream ? "Plug the camera in again, then press Start." : "Record it again."}`)), 10000);
  });
  if (!video.videoWidth) throw new Error(`${name}: a video without frames, such as sound alone: open one that shows the sensor.`);
  $("name").textContent = name;
  $("back").disabled = $("next").disabled = true, $("freeze").disabled = false;
  let last = performance.now(), rate = 0, count = 0;
  const measured = () => {
    see(video, video.videoWidth, video.videoHeight, name);
    if (film.resting) watch(film, count++);
    const now = performance.now();
    rate = 0.9 * rate + 0.1 * (1000 / Math.max(1, now - last)), last = now;
    if (state.known) $("rate").textContent += `, ${rate.toFixed(0)} frames a second`;
  };
  const frame = told(() => {
    if (state.film !== film) return;
    try {
      if (!state.frozen) measured();
    } catch (error) {
      stopFilm();
      throw error;
    }
    video.requestVideoFrameCallback(frame);
  });
  video.requestVideoFrameCallback(frame);
  await video.play();
}

/** Says whether the camera shows the skin at rest, every few frames. */
function watch(film, count) {
  film.resting.add(state.planes);
  if (count % 6 === 0) film.why = film.resting.why(), $("still").textContent = film.why || `Still and untouched: take the background ${state.known ? "again, where depth at rest is not 0" : "now"}.`;
  $("take").disabled = Boolean(film.why);
}

async function startCamera() {
  if (state.film?.stream) return stopFilm();
  stopFilm(), say("Allow the camera where the browser asks.");
  const { plan } = state, stream = await openCamera($("camera").value, plan), track = stream.getVideoTracks()[0];
  const video = document.createElement("video");
  video.srcObject = stream;
  track.onended = () => (stopFilm(), say("The camera has gone. Plug it in again, then press Start.", true));
  $("start").textContent = "Stop";
  await listCameras(track.getSettings().deviceId);
  say(state.known ? "" : WITHOUT);
  await play({ video, stream, resting: new Resting(plan.height, plan.width) }, track.label || "camera");
}

async function listCameras(chosen) {
  $("camera").replaceChildren(...(await cameras()).map(([id, name]) => new Option(name, id, false, id === chosen)));
}

function freeze(frozen) {
  state.frozen = frozen;
  $("freeze").textContent = frozen ? "Go on" : "Freeze";
}

const open = told(async (files) => {
  const plan = files.find((file) => file.name.endsWith(".plan"));
  const video = files.find((file) => file.type.startsWith("video/"));
  const images = files.filter((file) => file.type.startsWith("image/"));
  if (!plan && !video && !images.length) throw new Error("Expected a plan (.plan), images or a video, got none of them.");
  stopFilm();
  if (plan) {
    usePlan(new Uint8Array(await plan.arrayBuffer()));
    $("type").value = "";
    say(`${plan.name} is in use. Now start the camera, or open images or a video of this unit.`);
  }
  if (video) return say(state.known ? "" : WITHOUT), play({ video: Object.assign(document.createElement("video"), { src: URL.createObjectURL(video) }) }, video.name);
  if (images.length) {
    state.images = images.sort((a, b) => a.name.localeCompare(b.name, undefined, { numeric: true }));
    say(state.known ? "" : "Show an image without contact (the arrows go from one to the next), then take it as background.");
    await showImage(0);
  }
});

function download(parts, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob(parts));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

async function saveDepth() {
  const { plan, found } = state, kind = $("kind").value;
  download(await fileOf(kind, found.depth, plan), `depth_mm.${kind}`);
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
    if (step && state.found) moveCross(crossed()[0] + step[0], crossed()[1] + step[1]), event.preventDefault();
  });
  $("open").addEventListener("click", () => $("files").click());
  $("files").addEventListener("change", () => open([...$("files").files]));
  $("back").addEventListener("click", told(() => showImage(state.at - 1)));
  $("next").addEventListener("click", told(() => showImage(state.at + 1)));
  $("save").addEventListener("click", told(saveDepth));
  $("mine").addEventListener("click", () => {
    $("sensor").hidden = !$("sensor").hidden;
    $("mine").setAttribute("aria-expanded", String(!$("sensor").hidden));
  });
  $("type").addEventListener("change", told(chooseType));
  $("start").addEventListener("click", told(async () => startCamera().catch((error) => (stopFilm(), Promise.reject(error)))));
  $("camera").addEventListener("change", told(async () => state.film?.stream && (stopFilm(), await startCamera())));
  $("take").addEventListener("click", told(takeBackground));
  $("freeze").addEventListener("click", () => freeze(!state.frozen));
  $("download").addEventListener("click", () => download([state.plan.bytes()], "unit.plan"));
  document.addEventListener("keydown", (event) => {
    if (event.key === " " && event.target === document.body && state.film) freeze(!state.frozen), event.preventDefault();
  });
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
  state.plans = JSON.parse(new TextDecoder().decode(await bytesOf("plans.json")));
  $("type").append(...state.plans.map(({ name }, k) => new Option(name, k)));
  await listCameras();
  const demo = new File([await bytesOf("demo.png")], "a drawn press", { type: "image/png" });
  say("A ball pressed into a drawn sensor. Plug in yours, or drop a plan of it (pipe.freeze().save(\"unit.plan\")) and its images here.");
  try {
    state.surface = new Surface($("surface"));
  } catch (error) {
    say(error.message, true);
  }
  state.images = [demo];
  await showImage(0);
  listen();
  await navigator.serviceWorker?.register("worker.js"); // then the page opens without a network
  document.body.dataset.ready = "yes";
})();
