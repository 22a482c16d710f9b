// What the person at the page does with incidents. Each deed has an id of its own: sent twice over a bad
// line, it is done once.

import { $, html } from "./dom.js";
import { chosen, known, takeIncident } from "./state.js";
import { mayAct } from "./session.js";
import { name } from "./words.js";

let refresh = () => {};
let mergeFrom = null; // id of the incident that waits for its other half
let last = null; // { id, number, words }: what can be taken back
let toastEnds = 0;

export const isMerging = () => mergeFrom !== null;
export function listen(redraw) { refresh = redraw; }

const operator = () => localStorage.getItem("operator") ?? "";

/** Who acts; asked once, kept in this browser. */
async function whoActs() {
  return operator() || askName();
}

export function askName() {
  const dialog = $("name-dialog");
  $("name").value = operator();
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      const given = $("name").value.trim().slice(0, 64);
      if (dialog.returnValue === "ok" && given) localStorage.setItem("operator", given);
      showName();
      resolve(dialog.returnValue === "ok" ? given : "");
    }, { once: true });
  });
}

export function showName() {
  $("me").textContent = operator() || "Your name";
}

async function post(id, order) {
  const answer = await fetch(`/incidents/${encodeURIComponent(id)}/actions`, {
    method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(order),
  });
  const told = await answer.json().catch(() => ({}));
  if (!answer.ok) throw new Error(told.error ?? `the ground station answered ${answer.status}`);
  return told;
}

const uuid = () => crypto.randomUUID?.() ?? `${Date.now().toString(36)}-${Math.random().toString(36).slice(2)}`;

/** Sends one deed, and tells what became of it. */
async function send(id, kind, words, extra = {}) {
  if (!mayAct()) { toast("This sign-in may look, not act.", false, true); return; }
  const by = await whoActs();
  if (!by) return;
  try {
    const { action, incident } = await post(id, { id: uuid(), kind, by, ...extra });
    if (incident) takeIncident(incident);
    last = kind === "undo" ? null : { id: incident?.id ?? id, number: action.number, words };
    toast(words, last !== null);
  } catch (error) {
    toast(`Not done: ${error.message}`, false, true);
  }
  refresh();
}

export function act(kind, with_ = null) {
  const feature = chosen();
  if (!feature) return;
  const what = name(feature.properties);
  const words = { acknowledge: `${what} acknowledged`, confirm: `${what} confirmed`, dismiss: `${what} dismissed`, split: `${with_} is a fire of its own` }[kind];
  if (kind === "merge" && mayAct()) beginMerge(feature.id);
  else send(feature.id, kind, words, with_ ? { with: with_ } : {});
}

function beginMerge(id) {
  mergeFrom = id;
  $("merging-text").textContent = `Which incident is the same fire as ${id}? Choose it on the map or in the list.`;
  $("merging").hidden = false;
}

export function endMerge() {
  mergeFrom = null;
  $("merging").hidden = true;
}

/** True when the choice was the other half of a merge. */
export function mergeWith(id) {
  if (mergeFrom === null) return false;
  const from = mergeFrom;
  endMerge();
  if (id !== from) send(from, "merge", `${from} and ${id} are one fire`, { with: id });
  return true;
}

export function undo() {
  if (!last) return;
  send(last.id, "undo", `Taken back: ${last.words}`, { with: String(last.number) });
}

/** A line at the bottom for some seconds; what can be taken back stays a little longer. */
export function toast(text, canUndo = false, isBad = false) {
  const undoButton = canUndo ? html("button", { type: "button", "aria-keyshortcuts": "u" }, "Undo") : null;
  undoButton?.addEventListener("click", undo);
  $("toast").replaceChildren(html("span", {}, text), ...(undoButton ? [undoButton] : []));
  $("toast").dataset.bad = String(isBad);
  $("toast").hidden = false;
  clearTimeout(toastEnds);
  toastEnds = setTimeout(() => { $("toast").hidden = true; }, canUndo ? 12000 : 6000);
}

const details = { busy: new Set() };

/** Fetches an incident's alarms in full and its history, unless they are known as they are now. */
export async function fetchDetails(id) {
  const feature = known.incidents.get(id);
  if (!feature || details.busy.has(id) || known.details.get(id)?.row === feature.properties.row) return;
  details.busy.add(id);
  try {
    const answer = await fetch(`/incidents/${encodeURIComponent(id)}`);
    if (answer.ok) takeDetails(id, feature.properties.row, await answer.json());
  } catch { /* the line is lost, which the page says elsewhere */ }
  details.busy.delete(id);
  refresh();
}

function takeDetails(id, row, whole) {
  const history = whole.history ?? [], newest = new Map();
  for (const line of history) {
    const alarm = line.kind === "alarm" ? line.alarm : null;
    if (!alarm?.properties) continue;
    const before = newest.get(alarm.properties.id);
    if (!before || before.properties.revision < alarm.properties.revision) newest.set(alarm.properties.id, alarm);
  }
  known.details.set(id, { row, stamp: `${row}.${history.length}`, alarms: [...newest.values()], history });
}
