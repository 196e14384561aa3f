// The page: a plan and a camera, images or a video, to depth in 3D, its profile, and millimetres under the cursor.

import { Resting, doubtOf, touchOf } from "./background.js";
import { COLOURS } from "./colour.js";
import { doubtsOf } from "./conditions.js";
import { ballOf, median } from "./fit.js";
import { Rectify, cameras, openCamera } from "./frames.js";
import { fileOf, pressesOf } from "./save.js";
import { Surface } from "./surface.js";
import { Plan, library } from "./torchvts.js";

const $ = (id) => document.getElementById(id);
// known: whether the plan has the background of this unit; doubt: of that background; missized: whether balls are not as large as they should be;
// planes: the image that is shown, (3, height, width); film: the video or camera that plays; given: the files that were opened last; kept: presses
export const state = {
  c: null, plan: null, drawn: true, known: true, doubt: "", missized: false, asked: false, plans: [], planes: null, given: [], images: [], at: 0, found: null, cross: null,
  film: null, frozen: false, surface: null, background: null, filmed: false, kept: [], saved: true,
};

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

/** The unit of lengths; what is not known of it is said at each number. */
const unit = () => (!state.plan.metric ? "NOT mm" : state.doubt || state.missized ? "mm, in doubt" : "mm");

// ---- measuring ----

const reader = new OffscreenCanvas(1, 1), context = reader.getContext("2d", { willReadFrequently: true });

function pixelsOf(source, width, height) {
  if (reader.width !== width || reader.height !== height) Object.assign(reader, { width, height });
  context.clearRect(0, 0, width, height);
  context.drawImage(source, 0, 0);
  return context.getImageData(0, 0, width, height);
}

/** Takes a frame as its source gives it: the image in it, and its depth where the background is known. */
function see(source, width, height, name) {
  const { plan } = state;
  state.planes = state.rectify.image(pixelsOf(source, width, height), name);
  const start = performance.now(), cut = width === plan.width && height === plan.height ? "" : ` of ${width} x ${height}`;
  measure();
  const time = state.film && state.known ? `, measured and shown in ${(performance.now() - start).toFixed(1)} ms` : ""; // the first of all images takes longer
  $("rate").textContent = `${plan.width} x ${plan.height}${cut}${time}`;
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
    $("what").textContent = "no depth without a background", $("take").disabled = false;
    return;
  }
  state.found = { ...plan.measure(planes), pixels };
  $("save").disabled = $("download").disabled = $("take").disabled = false;
  $("keep").disabled = !state.background;
  show();
}

// ---- the background ----

/** Asks once more before a background is taken that may be none: sensors differ, and a doubt is no proof. */
function ask(again) {
  state.asked = again;
  $("take").textContent = again ? "Take it all the same" : "Take background";
}

/** The shown image, or the last frames of the camera, become the image without contact. */
function takeBackground() {
  const { plan, film } = state, image = film?.resting ? film.resting.image() : state.planes;
  const why = state.asked ? "" : film?.resting ? film.resting.why(plan) : touchOf(image, plan);
  ask(Boolean(why));
  if (why) throw new Error(`${why} Then take it; or take it all the same, if that is not so.`);
  const made = plan.withBackground(image), doubt = doubtOf(image, plan, state.known);
  plan.free();
  Object.assign(state, { plan: made, known: true, rectify: new Rectify(made), background: image, filmed: Boolean(film?.resting), found: null, doubt });
  measure();
  $("still").textContent = "";
  const check = film?.resting ? " Browsers may change a camera's colours: keep presses of a ball of known size before you trust the millimetres." : "";
  say(doubt ? `The background is taken, and in doubt: ${doubt}` : `The background is taken. Press something into the skin.${check}`, Boolean(doubt));
}

// ---- presses of a ball ----

/** The shown image is kept as a press of a ball; says the size that its depth has. */
function keepPress() {
  const { plan, found, kept } = state, ball = $("ball").valueAsNumber;
  if (!(ball > 0)) throw new Error("How large is the ball? Give its diameter in mm, then keep the press.");
  if (plan.about.view?.place) throw new Error("This sensor's calibration needs whole frames: torchvts calibrate --camera keeps them.");
  const read = ballOf(found, plan);
  if (!read) throw new Error("Nothing touches the skin here: press the ball, hold it (Freeze helps), then keep it.");
  kept.push({ image: state.planes, ball, share: read / ball }), (state.saved = false);
  $("zip").disabled = false, $("zip").textContent = `Save ${kept.length} press${kept.length > 1 ? "es" : ""}`;
  const off = median(kept.map(({ share }) => share)) - 1, all = kept.length > 1 ? `, the median of ${kept.length} ${sizeOf(off)}` : "";
  state.missized = Math.abs(off) > Math.max(0.15, 0.25 / Math.sqrt(kept.length)); // docs/web.md: how far presses are off
  const doubt = state.missized ? " Then depth is NOT in mm: is the diameter right, or does the browser change the camera's colours? A calibration from these presses mends that for this page." : "";
  say(`Kept: its depth is that of a ball of ${read.toFixed(1)} mm: ${sizeOf(read / ball - 1)}${all}.${doubt} Press elsewhere; eight to twelve make a calibration.`, state.missized);
  show();
}

const sizeOf = (off) => `${Math.abs(Math.round(100 * off))} % too ${off < 0 ? "small" : "large"}`;

async function savePresses() {
  download(await pressesOf(state.background, state.kept, state.plan), "presses.zip");
  state.saved = true;
  say(`Unpack presses.zip, then: torchvts calibrate presses --sensor ${state.plan.about.unit} --out unit.safetensors; torchvts view --web unit.safetensors shows it here.${elsewhere()}`);
}

const elsewhere = () => (state.filmed ? " Its colours are those that this browser makes of the camera: for Python, C and robots calibrate by torchvts calibrate --camera." : "");

// ---- showing ----

function show() {
  const { plan, found } = state;
  const { width, height } = plan;
  let most = 0, deepest = 0, touched = 0;
  found.depth.forEach((mm, k) => {
    if (mm > most) most = mm, deepest = k;
    touched += found.contact[k];
  });
  found.most = [0.2, 0.3, 0.5, 0.7, 1, 1.5, 2, 3, 5, 10].find((end) => most <= end) ?? most; // of few steps, so that colours stay while one presses
  found.deepest = most > 0 ? [deepest % width, Math.floor(deepest / width)] : [width >> 1, height >> 1];
  const picture = new ImageData(width, height);
  found.depth.forEach((mm, k) => {
    const at = 4 * Math.round(255 * Math.min(1, Math.max(0, mm / found.most)));
    picture.data.set(COLOURS.subarray(at, at + 4), 4 * k);
  });
  found.picture = picture;
  outline(found, width);
  $("most").textContent = `${found.most} ${unit()}`;
  const area = touched * plan.pitch * plan.pitch, { text, low } = doubtsOf(found.conditions);
  $("doubt").textContent = text;
  $("what").textContent = `deepest ${low ? "at least " : ""}${most.toFixed(3)} ${unit()}, contact ${area.toFixed(1)} mm²`;
  state.surface?.show(found.depth, height, width, plan.pitch, found.most);
  drawMaps();
}

/** Draws where something touches, in the image and in the depth. */
function outline({ contact, pixels, picture }, width) {
  contact.forEach((on, k) => {
    if (!on || (contact[k - 1] && contact[k + 1] && contact[k - width] && contact[k + width])) return;
    for (const { data } of [pixels, picture]) data.fill(255, 4 * k, 4 * k + 3);
  });
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
  $("under").textContent = `${mm.toFixed(3)} ${unit()} at x ${cross[0]}, y ${cross[1]}`;
  $("row").textContent = `along row ${cross[1]}, ${unit()}`;
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

// ---- plans ----

/** prior_deg: of a prior, which knows the type of a sensor and not this unit's background; else null. */
function usePlan(bytes, prior_deg = null, drawn = false) {
  if (!state.saved && !confirm("The presses that you kept are not saved. Go on without them?")) throw new Error("The presses are still here: save them first.");
  const plan = new Plan(state.c, bytes), known = prior_deg === null;
  state.plan?.free();
  Object.assign(state, { plan, drawn, known, doubt: "", missized: false, rectify: new Rectify(plan), planes: null, background: null, found: null, cross: null, images: [], kept: [], saved: true });
  for (const id of ["what", "under", "row", "rate", "name", "most", "doubt"]) $(id).textContent = "";
  for (const id of ["image", "depth", "profile"]) $(id).width = $(id).width; // clears it
  state.surface?.clear(), ask(false), ($("zip").textContent = "Save presses");
  for (const id of ["back", "next", "save", "take", "download", "keep", "zip"]) $(id).disabled = true;
  const scale = !plan.metric ? "the scale is NOT known" : known ? "lengths in mm" : `mm by the prior of its type, normals ${prior_deg.toFixed(1)}° off in the mean`;
  $("scale").textContent = `${plan.about.unit || "a unit"}, ${plan.about.mode}, ${(plan.pitch * 1000).toFixed(0)} µm a pixel, ${scale}`;
}

const WITHOUT = "Lift everything off the skin and keep it still, then take the background. Start the camera, or drop an image without contact.";
const CHOOSE = "Which sensor is it? Choose it first: what is shown is a drawn one.";

/** A prior of the page, or a plan of the user's; the files that were opened last are shown by it. */
async function chooseType() {
  const row = state.plans[$("type").value], { given } = state;
  if (!row) return ($("type").selectedIndex = 0), $("files").click();
  stopFilm();
  usePlan(row.bytes ?? (await bytesOf(row.file)), row.prior_deg);
  if (given.length) return open(given);
  if (state.known) return say(`${row.name}, is in use. Now start the camera, or open images or a video of this unit.`);
  say(`Depth by the prior of the type: normals of a unit that it has not seen are ${row.prior_deg.toFixed(1)} degrees off in the mean. ${WITHOUT}`);
}

/** Adds a plan to those that can be chosen, and chooses it. */
function offer(row, chosen = true) {
  state.plans.push(row);
  $("type").add(new Option(row.name, state.plans.length - 1, chosen, chosen), $("type").options.length - 1);
}

// ---- files ----

async function showImage(at) {
  const { images } = state;
  state.at = (at + images.length) % images.length;
  const file = images[state.at];
  const bitmap = await createImageBitmap(file).catch(() => {
    throw new Error(`${file.name}: no image that this browser reads: PNG, JPEG and WebP are.`);
  });
  ask(false);
  see(bitmap, bitmap.width, bitmap.height, file.name);
  $("name").textContent = images.length > 1 ? `${file.name} (${state.at + 1} of ${images.length})` : file.name;
  $("back").disabled = $("next").disabled = images.length < 2;
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
    $("rate").textContent += `, ${rate.toFixed(0)} frames a second`;
  };
  const frame = told(() => {
    if (state.film !== film) return;
    try {
      if (!state.frozen) measured();
    } catch (error) {
      stopFilm();
      throw error;
    }
    next(frame);
  });
  const next = video.requestVideoFrameCallback?.bind(video) ?? requestAnimationFrame; // Firefox has it since 2024
  next(frame);
  await video.play();
}

/** Says whether the camera shows the skin at rest, every few frames until there is a background. */
function watch({ resting }, count) {
  resting.add(state.planes, state.plan);
  if (count % 6 || (state.known && !state.asked)) return;
  const why = resting.why(state.plan);
  $("still").textContent = why || "Still and untouched: take the background now.";
  if (!why) ask(false);
}

async function startCamera() {
  if (state.film?.stream) return stopFilm();
  if (state.drawn) throw new Error(CHOOSE);
  stopFilm(), (state.given = []), say("Allow the camera where the browser asks.");
  const { plan } = state, stream = await openCamera($("camera").value, plan), track = stream.getVideoTracks()[0];
  const video = document.createElement("video");
  video.srcObject = stream;
  track.onended = () => (stopFilm(), say("The camera has gone. Plug it in again, then press Start.", true));
  $("start").textContent = "Stop";
  await listCameras(track.getSettings().deviceId);
  say(state.known ? "" : WITHOUT);
  await play({ video, stream, resting: new Resting() }, track.label || "camera");
}

async function listCameras(chosen) {
  $("camera").replaceChildren(...(await cameras()).map(([id, name]) => new Option(name, id, false, id === chosen)));
}

function freeze(frozen) {
  state.frozen = frozen;
  $("freeze").textContent = frozen ? "Go on" : "Freeze";
}

function showSensor(shown) {
  $("sensor").hidden = !shown, $("mine").setAttribute("aria-expanded", String(shown));
}

const open = told(async (files) => {
  const plan = files.find((file) => file.name.endsWith(".plan")), rest = files.filter((file) => file !== plan);
  const video = rest.find((file) => file.type.startsWith("video/"));
  const images = rest.filter((file) => file.type.startsWith("image/"));
  if (files.some((file) => file.name.endsWith(".safetensors"))) throw new Error("The page takes a calibration by torchvts view --web unit.safetensors, or as the plan that pipe.freeze().save(\"unit.plan\") writes.");
  if (!plan && !video && !images.length) throw new Error("Expected a plan (.plan), images or a video, got none of them.");
  if (plan) {
    const bytes = new Uint8Array(await plan.arrayBuffer());
    usePlan(bytes), stopFilm(), offer({ name: plan.name, bytes, prior_deg: null });
    say(`${plan.name} is in use. Now start the camera, or open images or a video of this unit.`);
  }
  state.given = rest;
  if (state.drawn) return showSensor(true), $("type").focus(), say(CHOOSE, true);
  if (rest.length) stopFilm();
  const without = state.known ? "" : "Take the background where nothing touches the skin: ";
  if (video) return say(without && `${without}freeze the video there.`), play({ video: Object.assign(document.createElement("video"), { src: URL.createObjectURL(video) }) }, video.name);
  if (images.length) {
    state.images = images.sort((a, b) => a.name.localeCompare(b.name, undefined, { numeric: true }));
    say(without && `${without}the arrows go from one image to the next.`);
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
    $(id).addEventListener("pointerleave", (event) => {
      if (event.pointerType === "mouse") state.cross = null, drawMaps(); // back to the deepest
    });
    $(id).addEventListener("pointermove", (event) => {
      const box = $(id).getBoundingClientRect(), { width, height } = state.plan, scale = Math.min(box.width / width, box.height / height);
      moveCross((event.clientX - box.left - box.width / 2) / scale + width / 2, (event.clientY - box.top - box.height / 2) / scale + height / 2);
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
  $("mine").addEventListener("click", () => showSensor($("sensor").hidden));
  $("type").addEventListener("change", told(chooseType));
  $("start").addEventListener("click", told(async () => startCamera().catch((error) => (stopFilm(), Promise.reject(error)))));
  $("camera").addEventListener("change", told(async () => state.film?.stream && (stopFilm(), await startCamera())));
  $("take").addEventListener("click", told(takeBackground));
  $("keep").addEventListener("click", told(keepPress));
  $("zip").addEventListener("click", told(savePresses));
  addEventListener("beforeunload", (event) => state.saved || event.preventDefault());
  $("freeze").addEventListener("click", () => freeze(!state.frozen));
  $("download").addEventListener("click", () => (download([state.plan.bytes()], "unit.plan"), say(`unit.plan is saved: drop it here another time.${elsewhere()}`)));
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
  usePlan(await bytesOf("demo.plan"), null, true);
  for (const row of JSON.parse(new TextDecoder().decode(await bytesOf("plans.json")))) offer(row, false);
  await listCameras();
  const demo = new File([await bytesOf("demo.png")], "a drawn press", { type: "image/png" });
  say("A ball pressed into a drawn sensor. Turn it; millimetres are under the cursor. For a GelSight Mini or DIGIT of yours: Use my sensor, or drop its images.");
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
