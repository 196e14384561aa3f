// Opens the page in Chromium by its DevTools protocol and does what a person would: page.mjs CHROMIUM URL FOLDER. Prints what it saw, as JSON.
import { spawn } from "node:child_process";
import { writeFileSync } from "node:fs";

const [chromium, url, folder] = process.argv.slice(2);
const flags = ["--headless=new", "--no-sandbox", "--enable-unsafe-swiftshader", "--use-angle=swiftshader", "--remote-debugging-port=0"];
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
const evaluate = async (expression) => (await send("Runtime.evaluate", { expression, awaitPromise: true, returnByValue: true })).result?.value;
const text = (id) => evaluate(`document.getElementById("${id}").textContent`);
const depth = () => evaluate(`import("./app.js").then(({ state }) => state.found && [...state.found.depth])`);
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

try {
  for (const part of ["Page", "Runtime", "DOM"]) await send(`${part}.enable`);
  await send("Page.navigate", { url });
  for (let k = 0; (await evaluate("document.body?.dataset.ready")) !== "yes" && k < 150; k++) await sleep(200);
  const seen = { demo: await depth(), under: await text("under"), drawn: await text("what") };
  await press("depth", "ArrowRight");
  seen.right = await text("under");
  await picture("light", 1280, 680, "light"), await picture("dark", 1280, 680, "dark"), await picture("phone", 390, 1300, "dark");
  seen.wide = await evaluate("document.documentElement.scrollWidth");
  await open("unit.plan");
  seen.plan = await text("status"), seen.empty = await depth();
  await open("image.png");
  seen.unit = await depth(), seen.about = await text("scale");
  await picture("unit", 1280, 680, "light");
  seen.refused = [];
  for (const name of ["light.png", "bad.plan", "none.txt", "none.png"]) await open(name), seen.refused.push(await text("status"));
  await open("film.webm"), await sleep(1500);
  seen.film = await text("rate"), seen.name = await text("name"), seen.said = await text("status"), seen.what = await text("what");
  seen.errors = errors;
  console.log(JSON.stringify(seen));
} finally {
  socket.close(), browser.kill();
}
