// The list of incidents and of aircraft.

import { $, html } from "./dom.js";
import { body } from "./card.js";
import { isDismissed, isNew, isOut, isSilent, known, newestAlarm, now, sorted } from "./state.js";
import { SIGN, age, bearing, metres, operatorText, title, trendText } from "./words.js";

function sign(p) {
  if (isOut(p) || isDismissed(p)) return p.class === "smoke" ? "○" : "△";
  return SIGN[p.class] ?? "■";
}

function head(feature) {
  const p = feature.properties, isChosen = feature.id === known.chosen;
  const button = html("button", { type: "button", "data-choose": feature.id, "aria-expanded": String(isChosen) },
    html("span", { class: "sign-text", "aria-hidden": "true" }, sign(p)), title(p));
  const when = html("span", { class: "age", "data-at": p.captured_at, title: p.captured_at }, age(now() - Date.parse(p.captured_at)));
  const untold = p.operator.state === "new" && !isNew(p);
  const badge = untold ? null : html("span", { class: "badge", "data-operator": p.operator.state }, operatorText(p.operator));
  const facts = [feature.id, `±${metres(p.ce90_m)}`, `${Math.round(p.confidence * 100)} % sure`, trendText(p)].filter(Boolean);
  return [
    html("div", { class: "head" }, html("h3", {}, button), when),
    html("p", { class: "what" }, badge, p.exercise ? html("span", { class: "badge exercise" }, "Exercise") : null, ` ${facts.join(" · ")}`),
  ];
}

function entry(feature) {
  const p = feature.properties, isChosen = feature.id === known.chosen;
  return html("li", {
    class: "incident", "data-id": feature.id, "data-class": p.class, "data-new": String(isNew(p)),
    "data-state": isDismissed(p) ? "out" : p.state, "data-chosen": String(isChosen),
  }, ...head(feature), ...(isChosen ? body(feature) : []));
}

/** What an entry was drawn from. */
function key(feature) {
  const isChosen = feature.id === known.chosen;
  return `${JSON.stringify(feature)}${isChosen}${isChosen ? known.details.get(feature.id)?.stamp : ""}`;
}

// Only what changed is replaced, so that focus and a half-made selection survive.
const shown = new Map(); // id -> what it was drawn from
const label = (e) => e.dataset.choose ?? e.dataset.act ?? e.getAttribute("aria-label")?.split(":")[0];

export function list() {
  const incidents = sorted(), items = $("incidents");
  const hidden = [...known.incidents.values()].filter((f) => isDismissed(f.properties)).length;
  $("none").hidden = incidents.length > 0;
  $("dismissed").hidden = hidden === 0;
  $("dismissed").textContent = known.showsDismissed ? "Hide dismissed" : `Show ${hidden} dismissed`;
  $("dismissed").setAttribute("aria-pressed", String(known.showsDismissed));
  const old = new Map([...items.children].map((item) => [item.dataset.id, item]));
  incidents.forEach((feature, place) => {
    let item = old.get(feature.id);
    if (!item || shown.get(feature.id) !== key(feature)) item = renew(items, item, feature);
    if (items.children[place] !== item) items.insertBefore(item, items.children[place]);
    old.delete(feature.id);
  });
  for (const [id, item] of old) { item.remove(); shown.delete(id); }
}

function renew(items, before, feature) {
  const fresh = entry(feature), active = document.activeElement;
  const focused = before?.contains(active) && label(active);
  if (before) before.replaceWith(fresh); else items.append(fresh);
  if (focused) [...fresh.querySelectorAll("button, summary")].find((b) => label(b) === focused)?.focus();
  shown.set(feature.id, key(feature));
  return fresh;
}

export function craftList() {
  $("aircraft-section").hidden = known.aircraft.size === 0;
  $("aircraft").replaceChildren(...[...known.aircraft].map(([uav, craft]) => {
    const { latest } = craft, quiet = now() - Date.parse(latest.at), silent = isSilent(craft);
    const isWell = latest.health === "ok";
    const heading = latest.heading_deg === null ? "" : `, ${bearing(latest.heading_deg)}`;
    const height = `${latest.height_ellipsoid_m.toFixed(0)} m`;
    const health = silent ? `silent, last heard ${age(quiet)}` : isWell ? "healthy" : latest.health;
    return html("li", { class: "aircraft", "data-health": silent ? "silent" : isWell ? "ok" : "poor" },
      html("span", { class: "dot", "aria-hidden": "true" }), html("b", {}, uav), " ",
      html("span", { class: "health" }, health), html("span", { class: "flight" }, `${silent ? "" : `, ${age(quiet)}`}, `,
        html("span", { title: "above the ellipsoid" }, height), heading));
  }));
}

export function summary() {
  const all = [...known.incidents.values()].map((f) => f.properties).filter((p) => !isOut(p) && !isDismissed(p));
  const sure = all.filter((p) => p.state !== "suspected"), guess = all.length - sure.length;
  const fires = sure.filter((p) => p.class === "fire").length, smoke = sure.length - fires;
  const fresh = sure.filter(isNew).length;
  const count = (n, one, many) => (n ? [`${n} ${n === 1 ? one : many}`] : []);
  const words = [...count(fires, "open fire", "open fires"), ...count(smoke, "smoke", "smokes"), ...count(guess, "suspected", "suspected")];
  $("summary").textContent = words.join(", ") || "No open fire";
  $("unseen-count").textContent = fresh ? `${fresh} new` : "";
  $("unseen-count").hidden = !fresh;
  document.title = `${fresh ? `(${fresh} new) ` : sure.length ? `(${sure.length}) ` : ""}${known.lost ? "No connection · " : ""}Fires · emberfix`;
}

export function choose(id) {
  known.chosen = known.chosen === id ? null : id;
  list();
  if (known.chosen === null) return;
  // On a phone the map covers the upper part, and an entry is longer than what is left.
  const block = matchMedia("(max-width: 820px)").matches ? "start" : "nearest";
  entryOf(id)?.scrollIntoView({ block });
}

export const entryOf = (id) => [...$("incidents").children].find((item) => item.dataset.id === id);
export { newestAlarm };
