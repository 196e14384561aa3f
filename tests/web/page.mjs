// Opens the page in Chromium by its DevTools protocol and does what a person would: page.mjs WHAT CHROMIUM URL FOLDER. Prints what it saw, as JSON.
import { spawn } from "node:child_process";
import { writeFileSync } from "node:fs";

const [what, chromium, url, folder] = process.argv.slice(2);
const CAMERA = ["--use-fake-device-for-media-stream", `--use-file-for-fake-video-capture=${folder}/camera.y4m`];
const SPECIAL = { walk: CAMERA, plain: ["--js-flags=--no-enable-sse4-1 --no-enable-ssse3"] };
const flags = ["--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--remote-debugging-port=0", ...(SPECIAL[what] ?? [])];
const browser = spawn(chromium, [...flags, `--user-data-dir=${folder}/profile`, "about:blank"], { stdio: ["ignore", "ignore", "pipe"] });
const sleep = (ms) => new Promise((done) => setTimeout(done, ms));
let said = "", last = 0;
browser.stderr.on("data", (text) => (said += text));
for (let k = 0; !/ws:\S+/.test(said) && k < 300; k++) await sleep(100);
const port = said.match(/ws:\/\/127\.0\.0\.1:(\d+)/)[1];
const pages = await (await fetch(`http://127.0.0.1:${port}/json`)).json();
const socket = new WebSocket(pages.find((page) => page.type === "page").webSocketDebuggerUrl);
await new Promise((open) => (socket.onopen = open));
const answers = new Map(), errors = [];
socket.onmessage = ({ data }) => {
  const message = JSON.parse(data);
  if (message.id) answers.get(message.id)(message.result);
  if (message.method === "Runtime.exceptionThrown") errors.push(message.params.exceptionDetails.exception?.description);
};
const send = (method, params = {}) =>
  new Promise((done) => {
    answers.set(++last, done);
    socket.send(JSON.stringify({ id: last, method, params }));
  });
const evaluate = async (expression) => (await send("Runtime.evaluate", { expression, awaitPromise: true, returnByValue: true, userGesture: true })).result?.value;
const text = (id) => evaluate(`document.getElementById("${id}").textContent`);
const base64 = `(floats) => btoa(Array.from(new Uint8Array(floats.buffer), (byte) => String.fromCharCode(byte)).join(""))`;
const array = (of) => evaluate(`import("./app.js").then(({ state }) => state.found && (${base64})(state.${of}))`);
const depth = () => array("found.depth");
const click = (id) => evaluate(`document.getElementById("${id}").click()`);
const choose = (id, value) => evaluate(`{ const one = document.getElementById("${id}"); one.value = "${value}"; one.dispatchEvent(new Event("change")); }`);
async function until(expression, seconds = 30) {
  for (let k = 0; k < 10 * seconds; k++) {
    if (await evaluate(expression)) return;
    await sleep(100);
  }
  throw new Error(`never: ${expression}; the page says: ${await text("status")} ${await text("still")}`);
}
const press = async (id, key) => {
  await evaluate(`document.getElementById("${id}").focus()`);
  await send("Input.dispatchKeyEvent", { type: "keyDown", key }), await send("Input.dispatchKeyEvent", { type: "keyUp", key });
};
async function open(...names) {
  const { root } = await send("DOM.getDocument");
  const { nodeId } = await send("DOM.querySelector", { nodeId: root.nodeId, selector: "#files" });
  await send("DOM.setFileInputFiles", { nodeId, files: names.map((name) => `${folder}/${name}`) });
  await sleep(1500);
}
async function picture(name, width, height, theme) {
  await send("Emulation.setDeviceMetricsOverride", { width, height, deviceScaleFactor: 1, mobile: width < 500 });
  await send("Emulation.setEmulatedMedia", { features: [{ name: "prefers-color-scheme", value: theme }] });
  await sleep(400);
  const { data } = await send("Page.captureScreenshot");
  writeFileSync(`${folder}/${name}.png`, Buffer.from(data, "base64"));
}
const ready = () => until(`document.body?.dataset.ready === "yes"`);

const sensorType = () => evaluate(`[...document.getElementById("type").options].find((one) => one.text.startsWith("gelsight_mini")).value`);

/** The drawn press, a plan with its images and a film, what is doubted, and what is refused. */
async function files(seen) {
  Object.assign(seen, { demo: await depth(), under: await text("under"), drawn: await text("what") });
  seen.ball = await evaluate(`Promise.all([import("./app.js"), import("./fit.js")]).then(([{ state }, { ballOf }]) => ballOf(state.found, state.plan))`);
  await picture("light", 1280, 680, "light"), await picture("dark", 1280, 680, "dark"), await picture("phone", 390, 1300, "dark");
  seen.wide = await evaluate("document.documentElement.scrollWidth");
  await press("depth", "ArrowRight");
  seen.right = await text("under"), seen.first = [];
  await click("start"), seen.first.push(await text("status"));
  await open("image.png"), seen.first.push(await text("status"), await depth());
  await open("unit.plan");
  seen.plan = await text("status"), seen.empty = await depth();
  await open("swapped.png"), (seen.doubt = [await text("doubt"), await text("what")]);
  await open("image.png");
  seen.sure = await text("doubt"), seen.unit = await depth(), seen.about = await text("scale");
  await picture("unit", 1280, 680, "light");
  seen.refused = [];
  for (const name of ["light.png", "bad.plan", "none.txt", "none.png", "sound.webm", "unit.safetensors"]) await open(name), seen.refused.push(await text("status"));
  await open("film.webm"), await sleep(1500);
  seen.film = await text("rate"), seen.name = await text("name"), seen.said = await text("status"), seen.what = await text("what");
}

/** A sensor by the prior of its type: background, press, freeze, what is saved. */
async function sensor(seen) {
  if (await evaluate(`document.getElementById("sensor").hidden`)) await click("mine");
  await choose("type", await sensorType());
  await until(`document.getElementById("scale").textContent.includes("by the prior")`);
  seen.prior = await text("scale");
  await send("Browser.setPermission", { permission: { name: "camera" }, setting: "denied" });
  await click("start"), await until(`document.getElementById("status").textContent.includes("refused")`);
  seen.denied = await text("status");
  await send("Browser.setPermission", { permission: { name: "camera" }, setting: "granted" });
  await evaluate(`document.getElementById("camera").append(new Option("one that was unplugged", "none", true, true))`);
  await click("start"), await until(`document.getElementById("status").textContent.includes("gone")`);
  seen.gone = await text("status");
  await evaluate(`document.getElementById("camera").replaceChildren()`), await click("start");
  await until(`document.getElementById("still").textContent.includes("touches") || document.getElementById("still").textContent.includes("moves")`);
  seen.touched = await text("still");
  await until(`document.getElementById("still").textContent.startsWith("Still") && !document.getElementById("take").disabled`);
  seen.still = await text("still"), seen.cameras = await evaluate(`document.getElementById("camera").textContent`);
  await picture("waiting", 1280, 760, "light");
  const taken = `(document.getElementById("take").click(), document.getElementById("status").textContent.startsWith("The background is taken"))`;
  await until(`document.getElementById("still").textContent.startsWith("Still") && document.getElementById("take").textContent === "Take background" && ${taken}`);
  await until(`Number(document.getElementById("what").textContent.split(" ")[1]) > 0.2 && !document.getElementById("freeze").click()`);
  Object.assign(seen, { taken: await text("status"), rate: await text("rate"), frozen: await text("freeze") });
  Object.assign(seen, { background: await array("background"), planes: await array("planes"), depth: await depth() });
  await picture("sensor", 1280, 760, "light"), await picture("sensor_dark", 1280, 760, "dark"), await picture("sensor_phone", 390, 1500, "light");
  seen.wider = await evaluate("document.documentElement.scrollWidth");
  await send("Browser.setDownloadBehavior", { behavior: "allow", downloadPath: `${folder}/saved` });
  for (const kind of ["npy", "png", "ply"]) await choose("kind", kind), await click("save"), await sleep(500);
  await click("download"), await sleep(1000);
  await click("keep"), (seen.unsized = await text("status"));
  await choose("ball", "6.31"), await click("keep"), await sleep(500), (seen.kept = await text("status"));
  await click("zip"), await sleep(3000), (seen.zip = await text("status"));
  await click("start");
  seen.stopped = await text("start");
}

/** Images in place of a camera: the one that is shown becomes the background. */
async function dropped(seen) {
  await choose("type", await sensorType()), await sleep(1000);
  await open("corner.png"), await click("take"), await sleep(500);
  seen.contact = [await text("status"), await text("take")];
  await open("a_rest.png", "b_press.png");
  seen.before = await depth();
  await click("take"), await sleep(500), await click("next"), await sleep(1000);
  seen.next = await depth();
}

try {
  for (const part of ["Page", "Runtime", "DOM"]) await send(`${part}.enable`);
  await send("Page.navigate", { url });
  const seen = { errors };
  if (what === "walk") await ready(), await files(seen), await sensor(seen), await dropped(seen);
  if (what === "offline") await ready(), (seen.demo = await depth());
  if (what === "none") {
    await ready(), await send("Browser.setPermission", { permission: { name: "camera" }, setting: "granted" });
    await choose("type", await sensorType()), await sleep(2000), await click("start");
    await until(`document.getElementById("status").textContent.includes("No camera")`);
  }
  if (what === "plain") await until(`!document.getElementById("status").textContent.startsWith("Starting")`);
  if (what === "file") await sleep(2000);
  seen.status = (await text("status")).replace(/\s+/g, " ");
  console.log(JSON.stringify(seen));
} finally {
  socket.close(), browser.kill();
}
