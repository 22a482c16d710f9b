// The line to the ground station: one stream of events, and what is said when it breaks.

import { $ } from "./dom.js";
import { SILENT_MS, forgetAll, known, takeGone, takeIncident, takePosition, takeTracks } from "./state.js";
import { enter, isAsking } from "./session.js";
import { age, clock } from "./words.js";
import { heed } from "./alert.js";
import { forgetPlane } from "./map.js";

const RETRY_MS = 2000;
let refresh = () => {}, entered = () => {};
let stream = null, lastId = null, retry = 0, triedAt = 0;
let isFresh = false; // what came since the stream caught up is news, before it is how things stand

const setClock = (text) => { known.clockAhead = Date.parse(text) - Date.now(); };

function lose() {
  if (known.lost) return;
  known.lost = true;
  document.body.dataset.lost = "true";
  $("line").dataset.state = "lost";
  $("line-text").textContent = "Not connected";
  tellLost();
  refresh();
}

/** The age of what is shown, anew every second. */
function tellLost() {
  if (!known.lost) return;
  $("banner").textContent = known.heardAt
    ? `No connection to the ground station. What you see is as of ${clock(known.heardAt)}, ${age(Date.now() - known.heardAt)}; it may have changed. Trying again.`
    : "No connection to the ground station yet. Trying again.";
  $("banner").hidden = false;
}

function heard() {
  known.heardAt = Date.now();
  if (!known.lost && $("line").dataset.state === "live") return;
  known.lost = false;
  delete document.body.dataset.lost;
  $("banner").hidden = true;
  $("line").dataset.state = "live";
  $("line-text").textContent = "Live";
}

/** Once a second. */
export function tick() {
  tellLost();
  const quiet = Date.now() - Math.max(known.heardAt, triedAt);
  if (quiet > SILENT_MS && !isAsking()) { lose(); connect(); }
}

/** Opens the line when the station lets us in; `inside` is called whenever it has. */
export function begin(redraw, inside) {
  [refresh, entered] = [redraw, inside];
  open();
}

async function open() {
  clearTimeout(retry);
  triedAt = Date.now();
  try {
    await enter();
  } catch {
    lose();
    retry = setTimeout(open, RETRY_MS);
    return;
  }
  connect();
  entered();
}

function connect() {
  stream?.close();
  clearTimeout(retry);
  triedAt = Date.now();
  isFresh = lastId !== null;
  stream = new EventSource(`/events?show=incidents${lastId === null ? "" : `&last_event_id=${lastId}`}`);
  const on = (kind, take) => stream.addEventListener(kind, (event) => {
    heard();
    take(JSON.parse(event.data), event);
    refresh();
  });
  on("hello", hello);
  on("time", (time) => setClock(time.now));
  on("incident", (feature) => {
    const { old, before } = takeIncident(feature);
    if (!old) heed(feature, before, isFresh);
  });
  on("gone", takeGone);
  on("upto", (_, event) => { lastId = event.lastEventId; isFresh = true; });
  on("track", takePosition);
  on("test", ({ at, link, uav }) => banner("tested", `${clock(at)}: test alarm from ${uav} over ${link} arrived. There is no fire.`));
  on("refused", ({ at, link, reason }) => banner("refused", `${clock(at)}: a report over ${link} was not taken. ${reason}`));
  stream.onerror = () => {
    lose();
    // The browser itself tries again after a broken line, but not after a refusal: perhaps we are not let in any more.
    if (stream.readyState === EventSource.CLOSED) retry = setTimeout(open, RETRY_MS);
  };
}

function hello({ now, store }) {
  setClock(now);
  if (known.store && known.store !== store) {
    // Another store counts its rows anew: nothing that we know holds there.
    forgetAll();
    forgetPlane();
    lastId = null;
    connect();
    return;
  }
  known.store = store;
  fetch("/track.geojson").then((r) => r.json()).then(takeTracks).then(refresh).catch(() => {});
}

function banner(id, text) {
  $(`${id}-text`).textContent = text;
  $(id).hidden = false;
}
