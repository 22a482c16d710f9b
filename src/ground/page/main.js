// The duty officer's page: one stream of events in, one drawing and one list out; nothing from elsewhere.

import * as actions from "./actions.js";
import * as alert from "./alert.js";
import { $, html } from "./dom.js";
import * as keys from "./keys.js";
import * as link from "./link.js";
import { choose as open, craftList, entryOf, list, summary } from "./list.js";
import * as map from "./map.js";
import * as session from "./session.js";
import { chosen, isOpen, known, now, sorted } from "./state.js";
import * as theme from "./theme.js";
import { load as loadTiles } from "./tiles.js";
import { age, places } from "./words.js";

let pending = false;
function refresh() {
  if (pending) return;
  pending = true;
  // A timer, not an animation frame: a page in the background keeps its title right.
  setTimeout(() => { pending = false; redraw(); }, 40);
}

function redraw() {
  list();
  craftList();
  summary();
  map.draw();
  ages();
  if (known.chosen) actions.fetchDetails(known.chosen);
  // The ground that burns is drawn for every open fire, as long as they are few.
  const burning = [...known.incidents.values()].filter((f) => isOpen(f.properties) && !known.details.has(f.id));
  if (known.incidents.size <= 20) burning.forEach((f) => actions.fetchDetails(f.id));
}

function ages() {
  for (const e of document.querySelectorAll("[data-at]")) e.textContent = age(now() - Date.parse(e.dataset.at));
}

function tick() {
  ages();
  const ground = new Date(now());
  const [local, utc] = [ground.toLocaleTimeString("en-GB"), ground.toISOString().slice(11, 19)];
  $("clock").textContent = local === utc ? `${utc} UTC` : `${local} · ${utc} UTC`;
  craftList();
  alert.tick();
  link.tick();
}

function choose(id) {
  if (!actions.mergeWith(id)) open(id);
  refresh();
}

/** The next or previous incident of the list. */
function step(by) {
  const ids = sorted().map((f) => f.id), at = ids.indexOf(known.chosen);
  const next = ids[at < 0 ? (by > 0 ? 0 : ids.length - 1) : Math.min(Math.max(at + by, 0), ids.length - 1)];
  if (!next || next === known.chosen) return;
  if (actions.isMerging()) { entryOf(next)?.querySelector("[data-choose]").focus(); return; }
  open(next);
  entryOf(next)?.querySelector("[data-choose]").focus();
  refresh();
}

async function copy(text, button) {
  try {
    await navigator.clipboard.writeText(text);
  } catch {
    // Browsers keep the clipboard from pages that come over plain HTTP from another machine.
    const area = html("textarea", {});
    area.value = text;
    document.body.append(area);
    area.select();
    document.execCommand("copy");
    area.remove();
    button?.focus();
  }
  if (!button) { actions.toast(`Copied ${text}`); return; }
  button.textContent = "Copied";
  setTimeout(() => { button.textContent = "Copy"; }, 1500);
}

$("incidents").addEventListener("click", (event) => {
  const button = event.target.closest("button");
  if (button?.dataset.copy) copy(button.dataset.copy, button);
  else if (button?.dataset.act) actions.act(button.dataset.act, button.dataset.with);
  else if (button?.dataset.choose) choose(button.dataset.choose);
});
for (const id of ["tested", "refused"]) $(`${id}-seen`).addEventListener("click", () => { $(id).hidden = true; });
$("merging-end").addEventListener("click", actions.endMerge);
$("dismissed").addEventListener("click", () => { known.showsDismissed = !known.showsDismissed; refresh(); });
$("me").addEventListener("click", actions.askName);
$("fit").addEventListener("click", map.fit);
$("zoom-in").addEventListener("click", () => map.zoom(1.5));
$("zoom-out").addEventListener("click", () => map.zoom(1 / 1.5));
window.addEventListener("hashchange", () => {
  const id = decodeURIComponent(location.hash.slice(1));
  if (known.incidents.has(id) && known.chosen !== id) choose(id);
});

keys.listen({
  j: () => step(1), k: () => step(-1), a: () => actions.act("acknowledge"), c: () => actions.act("confirm"),
  d: () => actions.act("dismiss"), m: () => actions.act("merge"), u: actions.undo,
  y: () => chosen() && copy(places(chosen().geometry.coordinates)[0][1]), z: () => map.approach(chosen()),
  0: map.fit, "+": () => map.zoom(1.5), "=": () => map.zoom(1.5), "-": () => map.zoom(1 / 1.5),
  s: alert.toggleSound, t: theme.next,
  Escape: () => { if (actions.isMerging()) actions.endMerge(); else if (known.chosen) choose(known.chosen); },
});
map.listen(choose);
actions.listen(refresh);
actions.showName();
alert.listen();
theme.listen();
setInterval(tick, 1000);
tick();
session.listen();
// Where a token is asked for, everything else waits for it.
link.begin(refresh, () => loadTiles().then(refresh).catch(() => {}));
