// Keeps the page's files, so that it opens without a network: the newest that the server gave, else those of the last time.

const FILES = ["./", "app.js", "background.js", "colour.js", "conditions.js", "fit.js", "frames.js", "save.js", "surface.js", "torchvts.js", "style.css"];
const MORE = ["torchvts.wasm", "demo.plan", "demo.png", "plans.json"];

addEventListener("install", (event) => {
  const all = async () => {
    const cache = await caches.open("torchvts"), plans = await (await fetch("plans.json")).json();
    await cache.addAll([...FILES, ...MORE, ...plans.map(({ file }) => file)]);
    await skipWaiting();
  };
  event.waitUntil(all());
});
addEventListener("activate", (event) => event.waitUntil(clients.claim()));
addEventListener("fetch", (event) => {
  const answer = async () => {
    const cache = await caches.open("torchvts");
    try {
      const found = await fetch(event.request);
      if (found.ok) await cache.put(event.request, found.clone());
      return found;
    } catch (error) {
      const kept = await cache.match(event.request, { ignoreSearch: true });
      if (kept) return kept;
      throw error;
    }
  };
  if (event.request.method === "GET") event.respondWith(answer());
});
